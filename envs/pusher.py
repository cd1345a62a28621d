"""Pusher: push a cylinder to a goal with a seven-joint arm."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.resets import InitialState
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import TaskOptions
from mjx_walk.envs.view import View
from mjx_walk.utils.setting_fields import setting

__all__ = ["Pusher", "PusherOptions"]

_VELOCITY_NOISE = 5e-3
"""Limit of the uniform noise on the joint velocities of a reset, rad/s."""
_OBJECT_LOW, _OBJECT_HIGH = (-0.3, -0.2), (0.0, 0.2)
"""Corners of the rectangle in which the object is drawn, relative to the goal, m."""
_MIN_GOAL_DISTANCE = 0.17
"""Least distance of the object from the goal at a reset, m."""
_NUM_JOINTS = 7
_NUM_PLACED = 4
"""Coordinates of the object and the goal, the last ones."""


@dataclasses.dataclass
class PusherOptions(TaskOptions):
    """Keyword arguments of Gymnasium's `PusherEnv`."""

    name: str = setting("pusher", choices=("pusher",))
    max_episode_steps: int = setting(100, at_least=1)
    reward_near_weight: float = 0.5
    """Weight of the distance from fingertip to object."""
    reward_dist_weight: float = 1.0
    """Weight of the distance from object to goal."""
    reward_control_weight: float = 0.1
    """Weight of the squared action."""


class Pusher(Task):
    """Pusher, whose episodes end only at the time limit.

    Source: `gymnasium/envs/mujoco/pusher_v5.py`. The last four coordinates of `qpos` are x and y of the object and of
    the goal. The model integrates with Euler.
    """

    GYMNASIUM_NAME = "Pusher"
    XML_FILES = {"v5": "pusher_v5.xml"}
    MISSING_VERSIONS = {"v4": "Gymnasium supports Pusher-v4 only with MuJoCo below 3"}
    REWARD_TERMS = {"v5": ("reward_dist", "reward_ctrl", "reward_near")}
    HAS_X = HAS_Y = False
    MODEL_NEEDS = ModelNeeds(positions=_NUM_JOINTS + _NUM_PLACED, velocities=_NUM_JOINTS + _NUM_PLACED)
    VIEW = View(body=11, center=(0.4, -0.2, -0.2), distance=2.2, elevation=-40.0, azimuth=200.0)

    options: PusherOptions

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        """Draw joint velocities, and an object that is not too close to the goal."""
        object_key, velocity_key = jax.random.split(key)
        moving = self.model.nv - _NUM_PLACED
        velocities = jax.random.uniform(velocity_key, (moving,), minval=-_VELOCITY_NOISE, maxval=_VELOCITY_NOISE)
        low, high = jnp.float32(_OBJECT_LOW), jnp.float32(_OBJECT_HIGH)

        def draw(drawn):
            key, draw_key = jax.random.split(drawn[0])
            return key, jax.random.uniform(draw_key, (2,), minval=low, maxval=high)

        _, position = jax.lax.while_loop(
            lambda drawn: jnp.linalg.norm(drawn[1]) <= _MIN_GOAL_DISTANCE, draw, (object_key, jnp.zeros(2))
        )
        qpos = self.init_qpos.at[-4:-2].set(position).at[-2:].set(0.0)
        return qpos, self.init_qvel.at[:moving].add(velocities).at[moving:].set(0.0)

    def named_bodies(self) -> tuple[int | str, ...]:
        return ("tips_arm", "object", "goal")

    def derived_names(self) -> tuple[str, ...]:
        return ("xpos",)

    def observation_blocks(self) -> dict[str, int]:
        return {"qpos": _NUM_JOINTS, "qvel": _NUM_JOINTS, "tips_arm": 3, "object": 3, "goal": 3}

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation `[23]`: joint angles, joint velocities, and the positions of fingertip, object and goal."""
        return jnp.concatenate([physics.qpos[:_NUM_JOINTS], physics.qvel[:_NUM_JOINTS], *self._positions(derived)])

    def _positions(self, derived: Derived) -> list[Float[Array, "3"]]:
        """Positions of fingertip, object and goal, m."""
        return [derived["xpos"][body] for body in self.body_ids.values()]

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        options = self.options
        tip, pushed, goal = self._positions(derived)
        terms = {
            "reward_dist": -options.reward_dist_weight * jnp.linalg.norm(pushed - goal),
            "reward_ctrl": -options.reward_control_weight * jnp.square(action).sum(),
            "reward_near": -options.reward_near_weight * jnp.linalg.norm(pushed - tip),
        }
        return terms, sum(terms.values(), jnp.float32(0.0)), jnp.zeros((), bool)
