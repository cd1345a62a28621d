"""InvertedPendulum: balance a pole on a cart."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.info import Info
from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.resets import InitialState, with_uniform_noise
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import MAX_FRAME_SKIP, TaskOptions
from mjx_walk.envs.view import View
from mjx_walk.utils.setting_fields import setting

__all__ = ["InvertedPendulum", "InvertedPendulumOptions"]

_MAX_ANGLE = 0.2
"""Largest angle of the pole from the vertical, rad."""


@dataclasses.dataclass
class InvertedPendulumOptions(TaskOptions):
    """Keyword arguments of Gymnasium's `InvertedPendulumEnv`. v4 takes none of them."""

    name: str = setting("inverted_pendulum", choices=("inverted_pendulum",))
    frame_skip: int = setting(2, at_least=1, at_most=MAX_FRAME_SKIP)
    reset_noise_scale: float = setting(1e-2, at_least=0)
    """Bound of the uniform noise on positions and velocities of a reset."""


class InvertedPendulum(Task):
    """InvertedPendulum, whose pole must not tilt by more than 0.2 rad.

    Source: `gymnasium/envs/mujoco/inverted_pendulum_v5.py` and `inverted_pendulum_v4.py`.
    """

    GYMNASIUM_NAME = "InvertedPendulum"
    XML_FILES = {"v5": "inverted_pendulum.xml", "v4": "inverted_pendulum.xml"}
    REWARD_TERMS = dict.fromkeys(("v5", "v4"), ("reward_survive",))
    V4_INFO_HAS_TERMS = False
    V5_ONLY = (*Task.V5_ONLY, "reset_noise_scale")
    HAS_Y = False
    MODEL_NEEDS = ModelNeeds(positions=2)
    VIEW = View(body=2, center=(0.0, 0.0, 0.2), distance=2.5)

    options: InvertedPendulumOptions

    @property
    def terminates_on_fall(self) -> bool:
        return True

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        return with_uniform_noise(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)

    def derived_names(self) -> tuple[str, ...]:
        return ()

    def observation_blocks(self) -> dict[str, int]:
        return {"qpos": self.model.nq, "qvel": self.model.nv}

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation `[4]`: position of the cart, angle of the pole, and their velocities."""
        return jnp.concatenate([physics.qpos, physics.qvel])

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        terminated = jnp.abs(physics.qpos[1]) > _MAX_ANGLE
        # v4 also pays in the step that terminates the episode.
        reward = jnp.float32(~terminated | (self.options.version == "v4"))
        return {"reward_survive": reward}, reward, terminated

    def step_info(self, before: State, after: State) -> Info:
        """As in Gymnasium, v5's term is an integer, `[] i32`."""
        info = super().step_info(before, after)
        return info if self.has_custom_reward else {name: value.astype(jnp.int32) for name, value in info.items()}
