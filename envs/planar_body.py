"""Base of Walker2d, Hopper and HalfCheetah: a body that runs along x, in the plane of x and z."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from mjx_walk.envs.info import Info
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.state import State
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import TaskOptions

__all__ = ["PlanarBody", "PlanarBodyOptions"]


@dataclasses.dataclass
class PlanarBodyOptions(TaskOptions):
    """Keyword argument of all planar bodies."""

    exclude_current_positions_from_observation: bool = True
    """Leave the root's x out of the observation."""


class PlanarBody(Task):
    """A body whose first coordinates are x, z and the torso's angle. It is observed without x, in its coordinates."""

    HAS_Y = False
    HEIGHT_INDEX = 1
    MAX_OBSERVED_VELOCITY: float | None = None
    """Limit to which observed velocities are clipped, m/s and rad/s. None: they are not clipped."""

    options: PlanarBodyOptions

    def derived_names(self) -> tuple[str, ...]:
        return ()

    def observation_blocks(self) -> dict[str, int]:
        skipped = int(self.options.exclude_current_positions_from_observation)
        return {"qpos": self.model.nq - skipped, "qvel": self.model.nv}

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation: height, torso angle and joint angles, then all velocities."""
        qpos = physics.qpos[1:] if self.options.exclude_current_positions_from_observation else physics.qpos
        qvel, limit = physics.qvel, self.MAX_OBSERVED_VELOCITY
        if limit is not None:
            qvel = jnp.clip(qvel, -limit, limit)
        return jnp.concatenate([qpos, qvel])

    def position_info(self, state: State) -> Info:
        return {"x_position": state.physics.qpos[0]}

    def velocity_info(self, before: State, after: State) -> Info:
        return {"x_velocity": (after.physics.qpos[0] - before.physics.qpos[0]) / self.dt}
