"""Hopper: hop forward on one leg, in a plane."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool

from mjx_walk.envs.body import is_within
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.planar_body import PlanarWalker, PlanarWalkerOptions
from mjx_walk.envs.task_options import MAX_FRAME_SKIP
from mjx_walk.utils.setting_fields import setting

__all__ = ["Hopper", "HopperOptions"]


@dataclasses.dataclass
class HopperOptions(PlanarWalkerOptions):
    """Keyword arguments of Gymnasium's `HopperEnv`."""

    name: str = setting("hopper", choices=("hopper",))
    frame_skip: int = setting(4, at_least=1, at_most=MAX_FRAME_SKIP)
    exclude_current_positions_from_observation: bool = True
    """Leave the root's x out of the observation."""
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


class Hopper(PlanarWalker):
    """Hopper, which hops forward and must not fall.

    Observation `[11]`: height, torso angle, three joint angles, and six clipped velocities.

    Reward and termination are in `PlanarWalker`: forward velocity, control cost and the healthy reward.

    Source: `gymnasium/envs/mujoco/hopper_v5.py` and `hopper_v4.py`.
    """

    GYMNASIUM_NAME = "Hopper"
    XML_FILES = {"v5": "hopper.xml", "v4": "hopper.xml"}

    options: HopperOptions

    def is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        """Whether also all coordinates but x and the height, and all velocities, are within their range."""
        state = jnp.concatenate([physics.qpos[2:], physics.qvel])
        return super().is_healthy(physics) & is_within(state, self.options.healthy_state_range).all()
