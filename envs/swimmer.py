"""Swimmer: swim forward with three links, in a plane of viscous fluid."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.info import Info, plane_position, plane_velocity
from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.resets import InitialState, with_uniform_noise
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import MAX_FRAME_SKIP, TaskOptions
from mjx_walk.envs.view import View
from mjx_walk.utils.setting_fields import setting

__all__ = ["Swimmer", "SwimmerOptions"]


@dataclasses.dataclass
class SwimmerOptions(TaskOptions):
    """Keyword arguments of Gymnasium's `SwimmerEnv`."""

    name: str = setting("swimmer", choices=("swimmer",))
    frame_skip: int = setting(4, at_least=1, at_most=MAX_FRAME_SKIP)
    forward_reward_weight: float = 1.0
    """Weight of the forward velocity."""
    ctrl_cost_weight: float = 1e-4
    """Weight of the squared action."""
    reset_noise_scale: float = setting(0.1, at_least=0)
    """Bound of the uniform noise on positions and velocities of a reset."""
    exclude_current_positions_from_observation: bool = True
    """Leave the root's x and y out of the observation."""


class Swimmer(Task):
    """Swimmer, whose episodes end only at the time limit.

    Source: `gymnasium/envs/mujoco/swimmer_v5.py` and `swimmer_v4.py`.
    """

    GYMNASIUM_NAME = "Swimmer"
    XML_FILES = {"v5": "swimmer.xml", "v4": "swimmer.xml"}
    REWARD_TERMS = {"v5": ("reward_forward", "reward_ctrl"), "v4": ("reward_fwd", "reward_ctrl")}
    VIEW = View(distance=8.0, elevation=-60.0)
    MODEL_NEEDS = ModelNeeds(positions=2)

    options: SwimmerOptions

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        return with_uniform_noise(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)

    def derived_names(self) -> tuple[str, ...]:
        return ()

    def observation_blocks(self) -> dict[str, int]:
        skipped = 2 * self.options.exclude_current_positions_from_observation
        return {"qpos": self.model.nq - skipped, "qvel": self.model.nv}

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation `[8]`: angle of the first link, two joint angles, and five velocities."""
        qpos = physics.qpos[2:] if self.options.exclude_current_positions_from_observation else physics.qpos
        return jnp.concatenate([qpos, physics.qvel])

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        options = self.options
        velocity = (physics.qpos[0] - before.physics.qpos[0]) / self.dt
        forward, control = self.gymnasium_reward_terms
        terms = {
            forward: options.forward_reward_weight * velocity,
            control: -options.ctrl_cost_weight * jnp.square(action).sum(),
        }
        return terms, sum(terms.values(), jnp.float32(0.0)), jnp.zeros((), bool)

    def position_info(self, state: State) -> Info:
        return plane_position(state.physics.qpos[:2])

    def velocity_info(self, before: State, after: State) -> Info:
        velocity = (after.physics.qpos[:2] - before.physics.qpos[:2]) / self.dt
        forward = {"forward_reward": self.options.forward_reward_weight * velocity[0]}
        return plane_velocity(velocity) | (forward if self.options.version == "v4" else {})
