"""Hopper: hop forward on one leg, in a plane."""

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

__all__ = ["Hopper", "HopperOptions"]


@dataclasses.dataclass
class HopperOptions(PlanarBodyOptions):
    """Keyword arguments of Gymnasium's `HopperEnv`."""

    name: str = setting("hopper", choices=("hopper",))
    frame_skip: int = setting(4, at_least=1, at_most=MAX_FRAME_SKIP)
    forward_reward_weight: float = 1.0
    """Weight of the forward velocity."""
    ctrl_cost_weight: float = 1e-3
    """Weight of the squared action."""
    healthy_reward: float = 1.0
    """Reward of one step in which the hopper is healthy."""
    terminate_when_unhealthy: bool = True
    """End the episode when the hopper is not healthy."""
    healthy_state_range: tuple[float, float] = (-100.0, 100.0)
    """Values of angles and velocities in which the hopper is healthy, rad, m/s and rad/s."""
    healthy_z_range: tuple[float, float] = (0.7, float("inf"))
    """Heights of the root in which the hopper is healthy, m."""
    healthy_angle_range: tuple[float, float] = (-0.2, 0.2)
    """Angles of the torso in which the hopper is healthy, rad."""
    reset_noise_scale: float = setting(5e-3, at_least=0)
    """Bound of the uniform noise on positions and velocities of a reset."""


class Hopper(PlanarBody):
    """Hopper, which hops forward and must not fall.

    Observation `[11]`: height, torso angle, three joint angles, and six clipped velocities.

    Source: `gymnasium/envs/mujoco/hopper_v5.py` and `hopper_v4.py`.
    """

    GYMNASIUM_NAME = "Hopper"
    XML_FILES = {"v5": "hopper.xml", "v4": "hopper.xml"}
    REWARD_TERMS = dict.fromkeys(("v5", "v4"), ("reward_forward", "reward_ctrl", "reward_survive"))
    V4_INFO_HAS_TERMS = False
    MAX_OBSERVED_VELOCITY = 10.0
    MODEL_NEEDS = ModelNeeds(positions=3)

    options: HopperOptions

    @property
    def terminates_on_fall(self) -> bool:
        return self.options.terminate_when_unhealthy

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        return with_uniform_noise(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        options = self.options
        is_healthy = _is_within(physics.qpos[1], options.healthy_z_range)
        is_healthy &= _is_within(physics.qpos[2], options.healthy_angle_range)
        # All coordinates except x and the height, and all velocities.
        is_healthy &= _is_within(physics.qpos[2:], options.healthy_state_range).all()
        is_healthy &= _is_within(physics.qvel, options.healthy_state_range).all()
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


def _is_within(value: Float[Array, "*shape"], bounds: tuple[float, float]) -> Bool[Array, "*shape"]:
    return (bounds[0] < value) & (value < bounds[1])
