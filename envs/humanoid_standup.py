"""HumanoidStandup: stand up from lying on the back, and keep standing."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from mjx_walk.envs.humanoid_body import HumanoidBody, HumanoidBodyOptions
from mjx_walk.envs.info import Info
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.utils.setting_fields import setting

__all__ = ["HumanoidStandup", "HumanoidStandupOptions"]


@dataclasses.dataclass
class HumanoidStandupOptions(HumanoidBodyOptions):
    """Keyword arguments of Gymnasium's `HumanoidStandupEnv`. v4 takes none of them."""

    name: str = setting("humanoid_standup", choices=("humanoid_standup",))
    uph_cost_weight: float = setting(1.0, only_if={})
    """Has no effect, as in Gymnasium."""
    ctrl_cost_weight: float = 0.1
    """Weight of the squared action."""
    impact_cost_weight: float = 0.5e-6
    """Weight of the squared contact forces."""
    impact_cost_range: tuple[float, float] = (-float("inf"), 10.0)
    """Bounds of the weighted impact cost."""


class HumanoidStandup(HumanoidBody):
    """HumanoidStandup, whose episodes end only at the time limit.

    Source: `gymnasium/envs/mujoco/humanoidstandup_v5.py` and `humanoidstandup_v4.py`.
    """

    GYMNASIUM_NAME = "HumanoidStandup"
    XML_FILES = {"v5": "humanoidstandup.xml", "v4": "humanoidstandup.xml"}
    REWARD_TERMS = dict.fromkeys(("v5", "v4"), ("reward_linup", "reward_quadctrl", "reward_impact"))
    V5_ONLY = (
        *HumanoidBody.V5_ONLY,
        "reset_noise_scale",
        "exclude_current_positions_from_observation",
        "uph_cost_weight",
        "ctrl_cost_weight",
        "impact_cost_weight",
        "impact_cost_range",
    )

    REWARD_OFFSET = 1.0

    options: HumanoidStandupOptions

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        options = self.options
        terms = {
            # Gymnasium divides by the physics time step, not by `dt`.
            "reward_linup": physics.qpos[2] / self.model.opt.timestep,
            "reward_quadctrl": -options.ctrl_cost_weight * jnp.square(action).sum(),
            "reward_impact": -self.contact_cost(derived, options.impact_cost_weight, options.impact_cost_range),
        }
        return terms, sum(terms.values(), jnp.float32(0.0)) + self.REWARD_OFFSET, jnp.zeros((), bool)

    def position_info(self, state: State) -> Info:
        if self.options.version == "v4":
            return {}
        x, y, z = state.physics.qpos[:3]
        height = {"z_distance_from_origin": z - self.model.qpos0[2]}
        return {"x_position": x, "y_position": y} | height | self.tendon_info(state)
