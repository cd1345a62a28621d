"""HalfCheetah: run forward on two legs, in a plane."""

import dataclasses

from jaxtyping import PRNGKeyArray

from mjx_walk.envs.planar_body import PlanarBody, PlanarBodyOptions
from mjx_walk.envs.resets import InitialState, with_normal_velocity
from mjx_walk.utils.setting_fields import setting

__all__ = ["HalfCheetah", "HalfCheetahOptions"]


@dataclasses.dataclass
class HalfCheetahOptions(PlanarBodyOptions):
    """Keyword arguments of Gymnasium's `HalfCheetahEnv`."""

    name: str = setting("half_cheetah", choices=("half_cheetah",))
    exclude_current_positions_from_observation: bool = True
    """Leave the root's x out of the observation."""
    forward_reward_weight: float = 1.0
    """Weight of the forward velocity."""
    ctrl_cost_weight: float = 0.1
    """Weight of the squared action."""
    reset_noise_scale: float = setting(0.1, at_least=0)
    """Bound of the uniform noise on positions of a reset, and std of the noise on velocities."""


class HalfCheetah(PlanarBody):
    """HalfCheetah, whose episodes end only at the time limit.

    Observation `[17]`: height, torso angle, six joint angles, and nine velocities.

    The reward is in `PlanarBody`: forward velocity and control cost.

    Source: `gymnasium/envs/mujoco/half_cheetah_v5.py` and `half_cheetah_v4.py`. The model integrates with Euler.
    """

    GYMNASIUM_NAME = "HalfCheetah"
    XML_FILES = {"v5": "half_cheetah.xml", "v4": "half_cheetah.xml"}
    REWARD_TERMS = {"v5": ("reward_forward", "reward_ctrl"), "v4": ("reward_run", "reward_ctrl")}

    options: HalfCheetahOptions

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        return with_normal_velocity(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)
