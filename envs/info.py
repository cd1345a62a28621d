"""Gymnasium's `info` dictionaries, as pure functions of states."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from mjx_walk.envs.state import State
from mjx_walk.envs.task_options import TaskOptions

__all__ = ["GymnasiumInfo", "Info", "plane_position", "plane_velocity"]

Info = dict[str, Array]
"""Entries of `info` by name: `[] f32`, or `[n] f32` for tendons."""


def plane_position(position: Float[Array | np.ndarray, "2"]) -> Info:
    """Entries of a position in the horizontal plane, x and y in m."""
    x, y = position
    norm = np.linalg.norm if isinstance(position, np.ndarray) else jnp.linalg.norm  # JAX would round it to float32
    return {"x_position": x, "y_position": y, "distance_from_origin": norm(position)}


def plane_velocity(velocity: Float[Array | np.ndarray, "2"]) -> Info:
    """Entries of a velocity in the horizontal plane, m/s."""
    x, y = velocity
    return {"x_velocity": x, "y_velocity": y}


class GymnasiumInfo:
    """The part of a task that names its equivalent in Gymnasium, and gives Gymnasium's `info`.

    Methods that take states take those of one environment, of a task with `keep_info`. Entries of states in NumPy's
    float64 are computed in float64.
    """

    options: TaskOptions
    GYMNASIUM_NAME: str
    """Name in Gymnasium's registry, without the version. A class without a name has no equivalent in Gymnasium."""
    REWARD_TERMS: dict[str, tuple[str, ...]]
    """Signed reward terms of each version, under the names of Gymnasium's `info`."""
    V4_INFO_HAS_TERMS: bool = True
    """Whether the `info` of Gymnasium's v4 class holds the reward terms. That of v5 always does."""
    REWARD_OFFSET: float = 0.0
    """Constant part of Gymnasium's reward, which no term holds."""
    reward_terms: tuple[str, ...]

    @classmethod
    def has_gymnasium_name(cls) -> bool:
        """Whether Gymnasium has an equivalent environment. A subclass does not inherit it."""
        return "GYMNASIUM_NAME" in vars(cls)

    @property
    def is_in_gymnasium(self) -> bool:
        """The same, of this task."""
        return self.has_gymnasium_name()

    @classmethod
    def id_of(cls, options: TaskOptions) -> str:
        """Id of the equivalent environment in Gymnasium; without one, the task's name."""
        return f"{cls.GYMNASIUM_NAME}-{options.version}" if cls.has_gymnasium_name() else options.name

    @property
    def gymnasium_id(self) -> str:
        """The same, of this task."""
        return self.id_of(self.options)

    def gymnasium_kwargs(self) -> dict[str, object]:
        """Keyword arguments of `gymnasium.make` for the equivalent environment, without those at their default."""
        return self.options.gymnasium_kwargs()

    @property
    def gymnasium_reward_terms(self) -> tuple[str, ...]:
        """Names of the terms of Gymnasium's reward."""
        return self.REWARD_TERMS[self.options.version]

    @property
    def has_custom_reward(self) -> bool:
        raise NotImplementedError

    def info_arrays(self) -> tuple[str, ...]:
        """Names of the `mjData` arrays that `info` holds."""
        return ()

    def position_info(self, state: State) -> Info:
        """Entries that depend on one state."""
        return {}

    def velocity_info(self, before: State, after: State) -> Info:
        """Entries that depend on the states before and after a step."""
        return {}

    def reset_info(self, state: State) -> Info:
        """The `info` of a reset. v4's is empty."""
        return self.position_info(state) if self.options.version == "v5" else {}

    def step_info(self, before: State, after: State) -> Info:
        """The `info` of a step. With a custom reward, all terms of that reward are in it."""
        names = self.REWARD_TERMS[self.options.version]
        if self.options.version == "v4" and not self.V4_INFO_HAS_TERMS:
            names = ()
        if self.has_custom_reward:
            names = self.reward_terms
        terms = {name: after.metrics[name] for name in names}
        return self.position_info(after) | self.velocity_info(before, after) | terms
