"""InvertedDoublePendulum: balance two poles, one on the other, on a cart."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.resets import InitialState, with_normal_velocity
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import TaskOptions
from mjx_walk.envs.view import View
from mjx_walk.utils.setting_fields import setting

__all__ = ["InvertedDoublePendulum", "InvertedDoublePendulumOptions"]

_MAX_OBSERVED_VELOCITY = 10.0
"""Limit to which observed velocities are clipped, m/s and rad/s."""
_MAX_OBSERVED_FORCE = 10.0
"""Limit to which observed constraint forces are clipped, N and N·m."""


@dataclasses.dataclass
class InvertedDoublePendulumOptions(TaskOptions):
    """Keyword arguments of Gymnasium's `InvertedDoublePendulumEnv`. v4 takes none of them."""

    name: str = setting("inverted_double_pendulum", choices=("inverted_double_pendulum",))
    healthy_reward: float = 10.0
    """Reward of one step in which the poles stand."""
    reset_noise_scale: float = setting(0.1, at_least=0)
    """Bound of the uniform noise on positions of a reset, and std of the noise on velocities."""


class InvertedDoublePendulum(Task):
    """InvertedDoublePendulum, whose tip must stay above 1 m.

    Source: `gymnasium/envs/mujoco/inverted_double_pendulum_v5.py` and `inverted_double_pendulum_v4.py`.
    """

    GYMNASIUM_NAME = "InvertedDoublePendulum"
    XML_FILES = {"v5": "inverted_double_pendulum.xml", "v4": "inverted_double_pendulum.xml"}
    REWARD_TERMS = dict.fromkeys(("v5", "v4"), ("reward_survive", "distance_penalty", "velocity_penalty"))
    V4_INFO_HAS_TERMS = False
    V5_ONLY = (*Task.V5_ONLY, "healthy_reward", "reset_noise_scale")
    HAS_Y = False
    MODEL_NEEDS = ModelNeeds(positions=2, velocities=3, sites=1)
    VIEW = View(body=3, center=(0.0, 0.0, 0.5))

    options: InvertedDoublePendulumOptions

    @property
    def terminates_on_fall(self) -> bool:
        return True

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        return with_normal_velocity(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)

    def derived_names(self) -> tuple[str, ...]:
        return ("site_xpos", "qfrc_constraint")

    def observation_blocks(self) -> dict[str, int]:
        num_poles, num_forces = self.model.nq - 1, 1 if self.options.version == "v5" else self.model.nv
        return {"qpos": 1, "sin": num_poles, "cos": num_poles, "qvel": self.model.nv, "qfrc_constraint": num_forces}

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation, `[9]` in v5 and `[11]` in v4.

        It holds the cart's position (1), sines (2) and cosines (2) of the poles' angles, clipped velocities (3), and
        clipped constraint forces: the cart's (1) in v5, all joints' (3) in v4.
        """
        angles = physics.qpos[1:]
        qvel = jnp.clip(physics.qvel, -_MAX_OBSERVED_VELOCITY, _MAX_OBSERVED_VELOCITY)
        forces = jnp.clip(derived["qfrc_constraint"], -_MAX_OBSERVED_FORCE, _MAX_OBSERVED_FORCE)
        observed_forces = forces[: self.observation_blocks()["qfrc_constraint"]]
        return jnp.concatenate([physics.qpos[:1], jnp.sin(angles), jnp.cos(angles), qvel, observed_forces])

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        x, _, z = derived["site_xpos"][0]
        terminated = z <= 1.0
        # v4 also pays in the step that terminates the episode.
        is_paid = ~terminated | (self.options.version == "v4")
        terms = {
            "reward_survive": self.options.healthy_reward * is_paid,
            "distance_penalty": -(0.01 * jnp.square(x) + jnp.square(z - 2.0)),
            "velocity_penalty": -(1e-3 * jnp.square(physics.qvel[1]) + 5e-3 * jnp.square(physics.qvel[2])),
        }
        return terms, sum(terms.values(), jnp.float32(0.0)), terminated
