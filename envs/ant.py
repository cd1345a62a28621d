"""Ant: run forward on four legs."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.body import Body, BodyOptions, HealthOptions, HealthyBody
from mjx_walk.envs.info import Info, plane_position, plane_velocity
from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.resets import InitialState, with_normal_velocity
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State
from mjx_walk.utils.setting_fields import setting

__all__ = ["Ant", "AntOptions"]


@dataclasses.dataclass
class AntOptions(BodyOptions, HealthOptions):
    """Keyword arguments of Gymnasium's `AntEnv`."""

    name: str = setting("ant", choices=("ant",))
    forward_reward_weight: float = 1.0
    """Weight of the forward velocity."""
    ctrl_cost_weight: float = 0.5
    """Weight of the squared action."""
    use_contact_forces: bool = setting(False, only_if={"version": "v4"})
    """Whether v4 observes contact forces and charges their cost."""
    contact_cost_weight: float = 5e-4
    """Weight of the squared contact forces."""
    healthy_reward: float = 1.0
    """Reward of one step in which the ant is healthy."""
    main_body: int | str = 1
    """Body whose forward speed is rewarded, by its index or name."""
    terminate_when_unhealthy: bool = True
    """End the episode when the ant is not healthy."""
    healthy_z_range: tuple[float, float] = (0.2, 1.0)
    """Heights of the root in which the ant is healthy, m."""
    contact_force_range: tuple[float, float] = (-1.0, 1.0)
    """Bounds of each contact force and torque, N and N·m."""
    reset_noise_scale: float = setting(0.1, at_least=0)
    """Bound of the uniform noise on positions of a reset, and std of the noise on velocities."""
    exclude_current_positions_from_observation: bool = True
    """Leave the root's x and y out of the observation."""
    include_cfrc_ext_in_observation: bool = True
    """Observe the contact forces on each body."""


class Ant(HealthyBody, Body):
    """Ant, which runs forward and must stay upright.

    Source: `gymnasium/envs/mujoco/ant_v5.py` and `ant_v4.py`.
    """

    GYMNASIUM_NAME = "Ant"
    XML_FILES = {"v5": "ant.xml", "v4": "ant.xml"}
    REWARD_TERMS = {
        "v5": ("reward_forward", "reward_ctrl", "reward_contact", "reward_survive"),
        "v4": ("reward_forward", "reward_ctrl", "reward_survive"),
    }
    V5_ONLY = ("frame_skip", "forward_reward_weight", "main_body", "include_cfrc_ext_in_observation")
    V4_ONLY = ("use_contact_forces",)
    HEIGHT_INDEX = 2
    MODEL_NEEDS = ModelNeeds(positions=3)

    options: AntOptions

    @property
    def gymnasium_reward_terms(self) -> tuple[str, ...]:
        unnamed = ("reward_quadctrl",) if self.options.use_contact_forces else ()
        return (*super().gymnasium_reward_terms, *unnamed)

    @property
    def _has_contact_cost(self) -> bool:
        return self.options.version == "v5" or self.options.use_contact_forces

    @property
    def _observes_forces(self) -> bool:
        return self._has_contact_cost and self.options.include_cfrc_ext_in_observation

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        return with_normal_velocity(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)

    def named_bodies(self) -> tuple[int | str, ...]:
        return (self.options.main_body if self.options.version == "v5" else "torso",)

    def derived_names(self) -> tuple[str, ...]:
        return ("xpos", "cfrc_ext") if self._has_contact_cost else ("xpos",)

    def observation_blocks(self) -> dict[str, int]:
        forces = {"cfrc_ext": 6 * (self.model.nbody - self._first_body)} if self._observes_forces else {}
        return super().observation_blocks() | forces

    @property
    def _first_body(self) -> int:
        """First body whose force is observed. v4 includes the zeros of the world body."""
        return 1 if self.options.version == "v5" else 0

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation, `[105]` in v5 and `[27]` in v4.

        It holds positions without x and y (13), velocities (14) and, in v5, clipped contact forces (78).
        """
        forces = [self._contact_forces(derived)[self._first_body :].ravel()] if self._observes_forces else []
        return jnp.concatenate([super().observe(physics, derived), *forces])

    def _contact_forces(self, derived: Derived) -> Float[Array, "nbody 6"]:
        return jnp.clip(derived["cfrc_ext"], *self.options.contact_force_range)

    def carry(self, physics: PhysicsState, derived: Derived) -> Carry:
        """Position of the main body `[2]`, x and y in m. The next step's velocity is its displacement."""
        (body,) = self.body_ids.values()
        return {"main_body": derived["xpos"][body, :2]}

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        options = self.options
        low, high = options.healthy_z_range
        survive, terminated = self.survival((low <= physics.qpos[2]) & (physics.qpos[2] <= high))
        velocity = (carry["main_body"][0] - before.memory["main_body"][0]) / self.dt
        terms = {
            "reward_forward": options.forward_reward_weight * velocity,
            "reward_ctrl": -options.ctrl_cost_weight * jnp.square(action).sum(),
            "reward_survive": survive,
        }
        if self._has_contact_cost:
            contact = -options.contact_cost_weight * jnp.square(self._contact_forces(derived)).sum()
            if options.version == "v5":
                terms["reward_contact"] = contact
            else:
                # As in Gymnasium, v4's `reward_ctrl` is then the contact cost; the control cost gets a name of ours.
                terms |= {"reward_ctrl": contact, "reward_quadctrl": terms["reward_ctrl"]}
        return terms, sum(terms.values(), jnp.float32(0.0)), terminated

    def position_info(self, state: State) -> Info:
        """The root's position in v5, and the torso's in v4, which is that of the last forward pass."""
        return plane_position(state.physics.qpos[:2] if self.options.version == "v5" else state.memory["main_body"])

    def velocity_info(self, before: State, after: State) -> Info:
        velocity = (after.memory["main_body"] - before.memory["main_body"]) / self.dt
        return plane_velocity(velocity) | ({"forward_reward": velocity[0]} if self.options.version == "v4" else {})
