"""Options of randomized physics, and their presets."""

import dataclasses

from mjx_walk.envs.option_presets import changes
from mjx_walk.utils.setting_fields import AnyBut, setting

__all__ = ["PRESETS", "Randomization", "changes_models"]

_CHANGES_MODELS = {
    **dict.fromkeys(("friction", "mass", "torque", "damping"), AnyBut((1.0, 1.0))),
    "center_of_mass": AnyBut(0.0),
}
"""Options that change the model itself, unless they have this value."""


@dataclasses.dataclass
class Randomization:
    """Ranges from which each episode draws its physics. The defaults change nothing."""

    friction: tuple[float, float] = setting((1.0, 1.0), above=0)
    """Range of a factor of the sliding friction of all geoms."""
    mass: tuple[float, float] = setting((1.0, 1.0), above=0)
    """Range of the factors of the bodies' masses and inertias, one for each body."""
    center_of_mass: float = setting(0.0, at_least=0)
    """Largest shift of the center of mass of the first body that moves, along each axis, m."""
    torque: tuple[float, float] = setting((1.0, 1.0), above=0)
    """Range of the factors of the motors' forces and force limits, one for each motor."""
    damping: tuple[float, float] = setting((1.0, 1.0), at_least=0)
    """Range of the factors of the joints' damping, one for each joint."""
    latency: tuple[float, float] = setting((0.0, 0.0), at_least=0, at_most=1)
    """Range of the time until an action reaches the motors, s, rounded to physics steps."""
    action_noise: float = setting(0.0, at_least=0)
    """Standard deviation of the noise on each action, relative to half the action's range."""
    observation_noise: float = setting(0.0, at_least=0)
    """Standard deviation of the noise on each observation, in the observation's unit."""
    push: float = setting(0.0, at_least=0)
    """Largest change of the horizontal velocity by a push, m/s. It moves the entire robot in a random direction."""
    push_seconds: tuple[float, float] = setting((3.0, 8.0), above=0, only_if={"push": AnyBut(0.0)})
    """Range of the time from one push to the next, s."""
    num_models: int = setting(1024, at_least=1, at_most=2**16, only_if=_CHANGES_MODELS)
    """Changed models. An episode draws one of them. They are the same in every run with the same ranges."""

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):  # a configuration file gives a range as a list
                setattr(self, field.name, tuple(value))


PRESETS = {
    "default": Randomization(
        friction=(0.5, 1.5),
        mass=(0.8, 1.2),
        center_of_mass=0.02,
        torque=(0.8, 1.2),
        damping=(0.5, 1.5),
        latency=(0.0, 0.02),
        action_noise=0.02,
        observation_noise=0.01,
        push=0.5,
    ),
}
"""Randomizations by name, for `env.randomize=NAME`."""


def changes_models(options: Randomization) -> bool:
    """Whether the options change the model itself."""
    return not _CHANGES_MODELS.keys().isdisjoint(changes(options))
