"""The body of Humanoid and HumanoidStandup: its observation and its contact cost."""

import dataclasses

import jax.numpy as jnp
import mujoco
from jax import Array
from jaxtyping import Float

from mjx_walk.envs.body import Body, BodyOptions
from mjx_walk.envs.info import Info
from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.state import State
from mjx_walk.envs.task import Task
from mjx_walk.utils.setting_fields import setting

__all__ = ["HumanoidBody", "HumanoidBodyOptions"]

_NUM_ROOT_DOFS = 6
"""Degrees of freedom of the root's free joint, which has no motor."""


@dataclasses.dataclass
class HumanoidBodyOptions(BodyOptions):
    """Keyword arguments of both humanoids. v4 does not take the flags `include_…`."""

    reset_noise_scale: float = setting(1e-2, at_least=0)
    """Bound of the uniform noise on positions and velocities of a reset."""
    exclude_current_positions_from_observation: bool = True
    """Leave the root's x and y out of the observation."""
    include_cinert_in_observation: bool = True
    """Observe mass and inertia of each body."""
    include_cvel_in_observation: bool = True
    """Observe the velocity of each body."""
    include_qfrc_actuator_in_observation: bool = True
    """Observe the motors' torques."""
    include_cfrc_ext_in_observation: bool = True
    """Observe the contact forces on each body."""


class HumanoidBody(Body):
    """Observation and contact cost of the humanoid with 17 motors."""

    V5_ONLY = (
        *Task.V5_ONLY,
        "include_cinert_in_observation",
        "include_cvel_in_observation",
        "include_qfrc_actuator_in_observation",
        "include_cfrc_ext_in_observation",
    )

    HEIGHT_INDEX = 2
    MODEL_NEEDS = ModelNeeds(positions=3)

    options: HumanoidBodyOptions

    def observed_arrays(self) -> tuple[str, ...]:
        """Names of the `mjData` arrays that the observation holds after positions and velocities, in order."""
        flags = {
            "cinert": self.options.include_cinert_in_observation,
            "cvel": self.options.include_cvel_in_observation,
            "qfrc_actuator": self.options.include_qfrc_actuator_in_observation,
            "cfrc_ext": self.options.include_cfrc_ext_in_observation,
        }
        return tuple(name for name, is_included in flags.items() if is_included)

    def derived_names(self) -> tuple[str, ...]:
        # The contact cost needs cfrc_ext even if the observation excludes it.
        return tuple(dict.fromkeys((*self.observed_arrays(), "cfrc_ext")))

    def _first_row(self, name: str) -> int:
        """First observed row of an array. v5 skips the world body and the root joint, v4 includes them."""
        if self.options.version == "v4":
            return 0
        return _NUM_ROOT_DOFS if name == "qfrc_actuator" else 1

    def observation_blocks(self) -> dict[str, int]:
        blank = mujoco.MjData(self.model)
        sizes = {name: getattr(blank, name)[self._first_row(name) :].size for name in self.observed_arrays()}
        return super().observation_blocks() | sizes

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation, `[348]` in v5 and `[376]` in v4.

        v5 holds positions without x and y (22), velocities (23), `cinert` (130), `cvel` (78), `qfrc_actuator` (17) and
        `cfrc_ext` (78). v4 also holds the zero rows of the world body and the zero torques of the root joint.
        """
        blocks = [derived[name][self._first_row(name) :].ravel() for name in self.observed_arrays()]
        return jnp.concatenate([super().observe(physics, derived), *blocks])

    def contact_cost(self, derived: Derived, weight: float, bounds: tuple[float, float]) -> Float[Array, ""]:
        """Weighted sum of the squared contact forces on all bodies, clipped to `bounds`."""
        return jnp.clip(weight * jnp.square(derived["cfrc_ext"]).sum(), *bounds)

    def info_arrays(self) -> tuple[str, ...]:
        return ("ten_length", "ten_velocity") if self.options.version == "v5" else ()

    def tendon_info(self, state: State) -> Info:
        """Lengths, rad, and velocities, rad/s, of the two tendons of hip and knee, `[2]` each."""
        return {"tendon_length": state.memory["ten_length"], "tendon_velocity": state.memory["ten_velocity"]}
