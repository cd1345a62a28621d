"""Humanoid: run forward on two legs."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from mjx_walk.envs.body import HealthOptions, HealthyBody, is_within
from mjx_walk.envs.humanoid_body import HumanoidBody, HumanoidBodyOptions
from mjx_walk.envs.info import Info, plane_position, plane_velocity
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.utils.setting_fields import setting

__all__ = ["Humanoid", "HumanoidOptions"]


@dataclasses.dataclass
class HumanoidOptions(HumanoidBodyOptions, HealthOptions):
    """Keyword arguments of Gymnasium's `HumanoidEnv`. v4 has no contact cost and does not take its options."""

    name: str = setting("humanoid", choices=("humanoid",))
    forward_reward_weight: float = 1.25
    """Weight of the forward velocity."""
    ctrl_cost_weight: float = 0.1
    """Weight of the squared action."""
    contact_cost_weight: float = 5e-7
    """Weight of the squared contact forces."""
    contact_cost_range: tuple[float, float] = (-float("inf"), 10.0)
    """Bounds of the weighted contact cost."""
    healthy_reward: float = 5.0
    """Reward of one step in which the humanoid is healthy."""
    terminate_when_unhealthy: bool = True
    """End the episode when the humanoid is not healthy."""
    healthy_z_range: tuple[float, float] = (1.0, 2.0)
    """Heights of the root in which the humanoid is healthy, m."""


class Humanoid(HealthyBody, HumanoidBody):
    """Humanoid, which runs forward and must not fall.

    Source: `gymnasium/envs/mujoco/humanoid_v5.py` and `humanoid_v4.py`.
    """

    GYMNASIUM_NAME = "Humanoid"
    XML_FILES = {"v5": "humanoid.xml", "v4": "humanoid.xml"}
    REWARD_TERMS = {
        "v5": ("reward_survive", "reward_forward", "reward_ctrl", "reward_contact"),
        "v4": ("reward_alive", "reward_linvel", "reward_quadctrl"),
    }
    V5_ONLY = (*HumanoidBody.V5_ONLY, "contact_cost_weight", "contact_cost_range")

    options: HumanoidOptions

    def derived_names(self) -> tuple[str, ...]:
        return (*super().derived_names(), "xipos")

    def carry(self, physics: PhysicsState, derived: Derived) -> Carry:
        """Center of mass `[2]`, x and y in m. The next step's forward velocity is its displacement."""
        mass = jnp.asarray(self.model.body_mass, jnp.float32)
        return {"mass_center": (mass[:, None] * derived["xipos"]).sum(0)[:2] / mass.sum()}

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        options = self.options
        survive, terminated = self.survival(is_within(physics.qpos[2], options.healthy_z_range))
        velocity = (carry["mass_center"][0] - before.memory["mass_center"][0]) / self.dt
        forward = options.forward_reward_weight * velocity
        control = -options.ctrl_cost_weight * jnp.square(action).sum()
        values: tuple[Array, ...] = (survive, forward, control)
        if options.version == "v5":
            contact = -self.contact_cost(derived, options.contact_cost_weight, options.contact_cost_range)
            values = (*values, contact)
        terms = dict(zip(self.gymnasium_reward_terms, values, strict=True))
        return terms, sum(terms.values(), jnp.float32(0.0)), terminated

    def position_info(self, state: State) -> Info:
        """The root's position and the tendons in v5, and the center of mass in v4."""
        if self.options.version == "v4":
            return plane_position(state.memory["mass_center"])
        return plane_position(state.physics.qpos[:2]) | self.tendon_info(state)

    def velocity_info(self, before: State, after: State) -> Info:
        velocity = (after.memory["mass_center"] - before.memory["mass_center"]) / self.dt
        forward = {"forward_reward": self.options.forward_reward_weight * velocity[0]}
        return plane_velocity(velocity) | (forward if self.options.version == "v4" else {})
