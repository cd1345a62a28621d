"""What Humanoid and HumanoidStandup share: the body and its observation."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco

from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.task import Task, TaskOptions

NUM_ROOT_DOFS = 6
"""Degrees of freedom of the free root joint, which has no motor."""


@dataclasses.dataclass
class HumanoidBodyOptions(TaskOptions):
    """Gymnasium's observation flags, v5 only."""

    include_cinert_in_observation: bool = True
    include_cvel_in_observation: bool = True
    include_qfrc_actuator_in_observation: bool = True
    include_cfrc_ext_in_observation: bool = True


class HumanoidBody(Task):
    """Observation and contact cost of the 17-motor humanoid."""

    V5_ONLY = (
        *Task.V5_ONLY,
        "include_cinert_in_observation",
        "include_cvel_in_observation",
        "include_qfrc_actuator_in_observation",
        "include_cfrc_ext_in_observation",
    )

    options: HumanoidBodyOptions

    def observed_arrays(self) -> tuple[str, ...]:
        """The observation's `mjData` arrays after positions and velocities, in order."""
        flags = {
            "cinert": self.options.include_cinert_in_observation,
            "cvel": self.options.include_cvel_in_observation,
            "qfrc_actuator": self.options.include_qfrc_actuator_in_observation,
            "cfrc_ext": self.options.include_cfrc_ext_in_observation,
        }
        return tuple(name for name, is_included in flags.items() if is_included)

    def derived_names(self) -> tuple[str, ...]:
        # The contact cost needs cfrc_ext even where it is not observed.
        return tuple(dict.fromkeys((*self.observed_arrays(), "cfrc_ext")))

    def _first_row(self, name: str) -> int:
        if self.options.version == "v4":
            return 0
        return NUM_ROOT_DOFS if name == "qfrc_actuator" else 1

    def observation_blocks(self) -> dict[str, int]:
        blank = mujoco.MjData(self.model)
        blocks = {"qpos": self.model.nq - 2 * self.options.exclude_current_positions_from_observation}
        blocks["qvel"] = self.model.nv
        return blocks | {name: getattr(blank, name)[self._first_row(name) :].size for name in self.observed_arrays()}

    def observe(self, physics: PhysicsState, derived: Derived) -> jax.Array:
        """`[348]` in v5: positions without x, y (22), velocities (23), then per body `cinert` (130), `cvel` (78),
        motor torques (17) and contact forces `cfrc_ext` (78).

        v4 keeps the world body's zero rows and the root's zero torques: `[376]`.
        """
        blocks = [derived[name][self._first_row(name) :].ravel() for name in self.observed_arrays()]
        qpos = physics.qpos[2:] if self.options.exclude_current_positions_from_observation else physics.qpos
        return jnp.concatenate([qpos, physics.qvel, *blocks])

    def contact_cost(self, derived: Derived, weight: float, bounds: tuple[float, float]) -> jax.Array:
        """Penalty on the squared contact forces of all bodies, clipped; positive."""
        return jnp.clip(weight * jnp.square(derived["cfrc_ext"]).sum(), *bounds)
