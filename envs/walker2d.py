"""Walker2d: run forward on two legs, in a plane."""

import dataclasses

from mjx_walk.envs.planar_body import PlanarWalker, PlanarWalkerOptions
from mjx_walk.envs.task_options import MAX_FRAME_SKIP
from mjx_walk.utils.setting_fields import setting

__all__ = ["Walker2d", "Walker2dOptions"]


@dataclasses.dataclass
class Walker2dOptions(PlanarWalkerOptions):
    """Keyword arguments of Gymnasium's `Walker2dEnv`."""

    name: str = setting("walker2d", choices=("walker2d",))
    frame_skip: int = setting(4, at_least=1, at_most=MAX_FRAME_SKIP)
    exclude_current_positions_from_observation: bool = True
    """Leave the root's x out of the observation."""
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


class Walker2d(PlanarWalker):
    """Walker2d, which runs forward and must not fall.

    Observation `[17]`: height, torso angle, six joint angles, and nine clipped velocities.

    Reward and termination are in `PlanarWalker`: forward velocity, control cost and the healthy reward.

    Source: `gymnasium/envs/mujoco/walker2d_v5.py` and `walker2d_v4.py`. In v4's model the right foot has friction 0.9.
    """

    GYMNASIUM_NAME = "Walker2d"
    XML_FILES = {"v5": "walker2d_v5.xml", "v4": "walker2d.xml"}

    options: Walker2dOptions
