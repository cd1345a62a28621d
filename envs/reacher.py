"""Reacher: reach a target with the tip of a two-joint arm, in a plane."""

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
from mjx_walk.envs.task_options import MAX_FRAME_SKIP, TaskOptions
from mjx_walk.envs.view import View
from mjx_walk.utils.setting_fields import setting

__all__ = ["Reacher", "ReacherOptions"]

_ANGLE_NOISE = 0.1
"""Limit of the uniform noise on the joint angles of a reset, rad."""
_VELOCITY_NOISE = 5e-3
"""Limit of the uniform noise on the joint velocities of a reset, rad/s."""
_TARGET_RADIUS = 0.2
"""Radius of the disc in which targets are drawn, m."""


@dataclasses.dataclass
class ReacherOptions(TaskOptions):
    """Keyword arguments of Gymnasium's `ReacherEnv`. v4 takes none of them."""

    name: str = setting("reacher", choices=("reacher",))
    frame_skip: int = setting(2, at_least=1, at_most=MAX_FRAME_SKIP)
    max_episode_steps: int = setting(50, at_least=1)
    reward_dist_weight: float = 1.0
    """Weight of the distance to the target."""
    reward_control_weight: float = 1.0
    """Weight of the squared action."""


class Reacher(Task):
    """Reacher, whose episodes end only at the time limit.

    Source: `gymnasium/envs/mujoco/reacher_v5.py` and `reacher_v4.py`. The last two coordinates of `qpos` are the
    target.
    """

    GYMNASIUM_NAME = "Reacher"
    XML_FILES = {"v5": "reacher.xml", "v4": "reacher.xml"}
    REWARD_TERMS = dict.fromkeys(("v5", "v4"), ("reward_dist", "reward_ctrl"))
    V5_ONLY = (*Task.V5_ONLY, "reward_dist_weight", "reward_control_weight")
    HAS_X = HAS_Y = False
    MODEL_NEEDS = ModelNeeds(positions=4, velocities=4, is_exact=True)
    VIEW = View(body=3, center=(0.0, 0.0, 0.0), distance=1.1, elevation=-90.0)

    options: ReacherOptions

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        """Draw joint angles, joint velocities, and a target uniformly in the disc."""
        angle_key, velocity_key, radius_key, direction_key = jax.random.split(key, 4)
        angles = jax.random.uniform(angle_key, (2,), minval=-_ANGLE_NOISE, maxval=_ANGLE_NOISE)
        velocities = jax.random.uniform(velocity_key, (2,), minval=-_VELOCITY_NOISE, maxval=_VELOCITY_NOISE)
        # The square root spreads the targets evenly over the disc. Gymnasium rejects draws outside it instead.
        radius = _TARGET_RADIUS * jnp.sqrt(jax.random.uniform(radius_key))
        direction = 2.0 * jnp.pi * jax.random.uniform(direction_key)
        target = radius * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
        qpos = jnp.concatenate([self.init_qpos[:2] + angles, target])
        return qpos, jnp.concatenate([self.init_qvel[:2] + velocities, jnp.zeros(2)])

    def named_bodies(self) -> tuple[int | str, ...]:
        return ("fingertip", "target")

    def derived_names(self) -> tuple[str, ...]:
        return ("xpos",)

    def observation_blocks(self) -> dict[str, int]:
        return {"cos": 2, "sin": 2, "qpos": 2, "qvel": 2, "to_target": 2 if self.options.version == "v5" else 3}

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation, `[10]` in v5 and `[11]` in v4.

        It holds cosines (2) and sines (2) of the joint angles, the target's x and y (2), joint velocities (2), and the
        fingertip's position relative to the target: x and y in v5, also z in v4.
        """
        angles = physics.qpos[:2]
        to_target = self._to_target(derived)[: self.observation_blocks()["to_target"]]
        return jnp.concatenate([jnp.cos(angles), jnp.sin(angles), physics.qpos[2:], physics.qvel[:2], to_target])

    def _to_target(self, derived: Derived) -> Float[Array, "3"]:
        """Position of the fingertip relative to the target, m."""
        xpos = derived["xpos"]
        return xpos[self.body_ids["fingertip"]] - xpos[self.body_ids["target"]]

    def carry(self, physics: PhysicsState, derived: Derived) -> Carry:
        """In v4, the fingertip's position relative to the target `[3]`, m: v4 rewards the position before the step."""
        return {"to_target": self._to_target(derived)} if self.options.version == "v4" else {}

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        to_target = before.memory["to_target"] if self.options.version == "v4" else self._to_target(derived)
        terms = {
            "reward_dist": -self.options.reward_dist_weight * jnp.linalg.norm(to_target),
            "reward_ctrl": -self.options.reward_control_weight * jnp.square(action).sum(),
        }
        return terms, sum(terms.values(), jnp.float32(0.0)), jnp.zeros((), bool)
