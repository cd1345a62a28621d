"""Walker2d: run forward on two legs, in a plane."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.info import Info
from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.planar_body import PlanarBody, PlanarBodyOptions
from mjx_walk.envs.resets import InitialState, with_uniform_noise
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.envs.task_options import MAX_FRAME_SKIP
from mjx_walk.utils.setting_fields import setting

__all__ = ["Walker2d", "Walker2dOptions"]


@dataclasses.dataclass
class Walker2dOptions(PlanarBodyOptions):
    """Keyword arguments of Gymnasium's `Walker2dEnv`."""

    name: str = setting("walker2d", choices=("walker2d",))
    frame_skip: int = setting(4, at_least=1, at_most=MAX_FRAME_SKIP)
    reset_noise_scale: float = setting(5e-3, at_least=0)
    """Bound of the uniform noise on positions and velocities of a reset."""
    forward_reward_weight: float = 1.0
    """Weight of the forward velocity."""
    ctrl_cost_weight: float = 1e-3
    """Weight of the squared action."""
    healthy_reward: float = 1.0
    """Reward of one step in which the walker is healthy."""
    terminate_when_unhealthy: bool = True
    """End the episode when the walker is not healthy."""
    healthy_z_range: tuple[float, float] = (0.8, 2.0)
    """Heights of the root in which the walker is healthy, m."""
    healthy_angle_range: tuple[float, float] = (-1.0, 1.0)
    """Angles of the torso in which the walker is healthy, rad."""


class Walker2d(PlanarBody):
    """Walker2d, which runs forward and must not fall.

    Observation `[17]`: height, torso angle, six joint angles, and nine clipped velocities.

    Source: `gymnasium/envs/mujoco/walker2d_v5.py` and `walker2d_v4.py`. In v4's model the right foot has friction 0.9.
    """

    GYMNASIUM_NAME = "Walker2d"
    XML_FILES = {"v5": "walker2d_v5.xml", "v4": "walker2d.xml"}
    MAX_OBSERVED_VELOCITY = 10.0
    MODEL_NEEDS = ModelNeeds(positions=3)
    REWARD_TERMS = dict.fromkeys(("v5", "v4"), ("reward_forward", "reward_ctrl", "reward_survive"))
    V4_INFO_HAS_TERMS = False

    options: Walker2dOptions

    @property
    def terminates_on_fall(self) -> bool:
        return self.options.terminate_when_unhealthy

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        return with_uniform_noise(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        options = self.options
        height, angle = physics.qpos[1], physics.qpos[2]
        is_healthy = (options.healthy_z_range[0] < height) & (height < options.healthy_z_range[1])
        is_healthy &= (options.healthy_angle_range[0] < angle) & (angle < options.healthy_angle_range[1])
        # v4 also pays the healthy reward in the step that terminates the episode.
        is_paid = is_healthy | (options.terminate_when_unhealthy and options.version == "v4")
        terms = {
            "reward_forward": options.forward_reward_weight * (physics.qpos[0] - before.physics.qpos[0]) / self.dt,
            "reward_ctrl": -options.ctrl_cost_weight * jnp.square(action).sum(),
            "reward_survive": options.healthy_reward * is_paid,
        }
        return terms, sum(terms.values(), jnp.float32(0.0)), ~is_healthy & options.terminate_when_unhealthy

    def position_info(self, state: State) -> Info:
        height = {"z_distance_from_origin": state.physics.qpos[1] - self.init_qpos[1]}
        return super().position_info(state) | (height if self.options.version == "v5" else {})
