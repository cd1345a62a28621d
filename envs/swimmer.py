"""Swimmer: swim forward with three links, in a plane of viscous fluid."""

import dataclasses

from mjx_walk.envs.info import Info, plane_position, plane_velocity
from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.planar_body import PlanarBody, PlanarBodyOptions
from mjx_walk.envs.state import State
from mjx_walk.envs.task_options import MAX_FRAME_SKIP
from mjx_walk.envs.view import View
from mjx_walk.utils.setting_fields import setting

__all__ = ["Swimmer", "SwimmerOptions"]


@dataclasses.dataclass
class SwimmerOptions(PlanarBodyOptions):
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


class Swimmer(PlanarBody):
    """Swimmer, in the plane of x and y. Its episodes end only at the time limit.

    Observation `[8]`: angle of the first link, two joint angles, and five velocities.

    The reward is in `PlanarBody`: forward velocity and control cost.

    Source: `gymnasium/envs/mujoco/swimmer_v5.py` and `swimmer_v4.py`.
    """

    GYMNASIUM_NAME = "Swimmer"
    XML_FILES = {"v5": "swimmer.xml", "v4": "swimmer.xml"}
    REWARD_TERMS = {"v5": ("reward_forward", "reward_ctrl"), "v4": ("reward_fwd", "reward_ctrl")}
    HAS_Y = True
    HEIGHT_INDEX = None
    NUM_PLACE_COORDINATES = 2
    VIEW = View(distance=8.0, elevation=-60.0)
    MODEL_NEEDS = ModelNeeds(positions=2)

    options: SwimmerOptions

    def position_info(self, state: State) -> Info:
        return plane_position(state.physics.qpos[:2])

    def velocity_info(self, before: State, after: State) -> Info:
        velocity = (after.physics.qpos[:2] - before.physics.qpos[:2]) / self.dt
        forward = {"forward_reward": self.options.forward_reward_weight * velocity[0]}
        return plane_velocity(velocity) | (forward if self.options.version == "v4" else {})
