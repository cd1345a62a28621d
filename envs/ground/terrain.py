"""The ground of a task: what its steps and resets need, and nothing if it is flat."""

import jax.numpy as jnp
import mujoco
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.envs.ground.hills import Hills, has_hills, with_hills
from mjx_walk.envs.ground.options import Ground
from mjx_walk.envs.models import is_coordinate
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.resets import InitialState
from mjx_walk.utils.errors import UserError

__all__ = ["Terrain"]

_LARGEST_OFFSET = 1e-6
"""Of a root's place from its first coordinates, m."""


class Terrain:
    """The ground under a body whose first coordinates are its place. A flat one changes nothing."""

    def __init__(self, ground: Ground, task: str, has_x: bool, has_y: bool, height_index: int | None):
        """
        Args:
            ground: its options.
            task: name of the task, for errors.
            has_x: whether `qpos[0]` is the root's x.
            has_y: whether `qpos[1]` is the root's y.
            height_index: index of the root's height in `qpos`; None if the root has none.

        Raises:
            UserError: the task's body cannot climb, and the ground is not flat.
        """
        is_flat = not (ground.slope or ground.step_height or ground.roughness)
        self._hills = None if is_flat else Hills(ground)
        self._has_y = has_y
        self._height_index = height_index
        if self._hills and not (has_x and height_index is not None):
            raise UserError(
                f"env.ground: {task} has no root that moves along x and up and down (HAS_X and HEIGHT_INDEX of its "
                "class); leave env.ground out"
            )

    @property
    def is_on(self) -> bool:
        """Whether the ground is not flat."""
        return self._hills is not None

    def added_to(self, spec: mujoco.MjSpec, flat: mujoco.MjModel | None = None) -> mujoco.MjModel:
        """A model on this ground, which is not flat.

        Args:
            spec: the model, which changes.
            flat: what `spec` was last compiled to, unchanged since. Default: it is compiled here.

        Raises:
            UserError: its floor cannot have hills.
        """
        assert self._hills
        return with_hills(spec, self._hills, flat)

    def check(self, model: mujoco.MjModel) -> None:
        """Check that a task's model has the hills, and that its first coordinates are the root's place in the world.

        Raises:
            UserError: it has not, or they are not.
        """
        if not self._hills:
            return
        if not has_hills(model, self._hills):
            raise UserError(
                "env.ground: the model has no hills, because load_model of its task does not add them; return "
                "self.ground.added_to(spec) there"
            )
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        for axis in range(1 + self._has_y):
            place = data.xpos[model.jnt_bodyid[0], axis]
            if not is_coordinate(model, axis, axis) or abs(place - model.qpos0[axis]) > _LARGEST_OFFSET:
                raise UserError(f"env.ground: qpos[{axis}] of the model is not the root's {'xy'[axis]} in the world")

    def height(self, x: Float[Array, "*shape"], y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Height of a ground that is not flat above the model's floor at some places, m."""
        assert self._hills
        return self._hills.height(x, y)

    def start(self, key: PRNGKeyArray, state: InitialState) -> InitialState:
        """Move the start of an episode to the foot of a hill, which is flat."""
        if not self._hills:
            return state
        qpos, qvel = state
        place = self._hills.start(key, self._has_y)
        return qpos.at[: len(place)].add(place), qvel

    def relative(self, physics: PhysicsState) -> PhysicsState:
        """The physics with the root's height above the ground, as observations and rewards take it."""
        if not self._hills:
            return physics
        x, y = physics.qpos[0], physics.qpos[1] if self._has_y else jnp.float32(0.0)
        return physics._replace(qpos=physics.qpos.at[self._height_index].add(-self._hills.height(x, y)))
