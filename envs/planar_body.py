"""Bases of HalfCheetah, Swimmer, Hopper and Walker2d: bodies that move along x, in a plane."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from mjx_walk.envs.body import Body, BodyOptions, HealthOptions, HealthyBody, is_within
from mjx_walk.envs.info import Info
from mjx_walk.envs.models import ModelNeeds
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.state import Carry, State

__all__ = ["PlanarBody", "PlanarBodyOptions", "PlanarWalker", "PlanarWalkerOptions"]


class PlanarBodyOptions(BodyOptions):
    """Keyword arguments that `PlanarBody` reads. The dataclass of each task defines them, in Gymnasium's order."""

    forward_reward_weight: float
    ctrl_cost_weight: float


class PlanarBody(Body):
    """A body in the plane of x and z, whose first coordinates are x, z and the torso's angle. It runs forward."""

    HAS_Y = False
    HEIGHT_INDEX: int | None = 1
    NUM_PLACE_COORDINATES = 1

    options: PlanarBodyOptions

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        """The weighted forward velocity minus the control cost. Episodes end only at the time limit."""
        velocity = (physics.qpos[0] - before.physics.qpos[0]) / self.dt
        forward, control, *_ = self.gymnasium_reward_terms
        terms = {
            forward: self.options.forward_reward_weight * velocity,
            control: -self.options.ctrl_cost_weight * jnp.square(action).sum(),
        }
        return terms, sum(terms.values(), jnp.float32(0.0)), jnp.zeros((), bool)

    def position_info(self, state: State) -> Info:
        return {"x_position": state.physics.qpos[0]}

    def velocity_info(self, before: State, after: State) -> Info:
        return {"x_velocity": (after.physics.qpos[0] - before.physics.qpos[0]) / self.dt}


class PlanarWalkerOptions(PlanarBodyOptions, HealthOptions):
    """Keyword arguments that `PlanarWalker` reads. The dataclass of each task defines them, in Gymnasium's order."""

    healthy_z_range: tuple[float, float]
    healthy_angle_range: tuple[float, float]


class PlanarWalker(HealthyBody, PlanarBody):
    """Hopper and Walker2d, which must not fall. Their observed velocities are clipped."""

    REWARD_TERMS = dict.fromkeys(("v5", "v4"), ("reward_forward", "reward_ctrl", "reward_survive"))
    V4_INFO_HAS_TERMS = False
    MODEL_NEEDS = ModelNeeds(positions=3)
    MAX_OBSERVED_VELOCITY = 10.0
    """Limit to which observed velocities are clipped, m/s and rad/s."""

    options: PlanarWalkerOptions

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        qvel = jnp.clip(physics.qvel, -self.MAX_OBSERVED_VELOCITY, self.MAX_OBSERVED_VELOCITY)
        return super().observe(physics._replace(qvel=qvel), derived)

    def is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        """Whether the root's height and the torso's angle are within their ranges."""
        is_high = is_within(physics.qpos[1], self.options.healthy_z_range)
        return is_high & is_within(physics.qpos[2], self.options.healthy_angle_range)

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        terms, reward, _ = super().reward_and_termination(before, physics, derived, carry, action)
        survive, terminated = self.survival(self.is_healthy(physics))
        return terms | {"reward_survive": survive}, reward + survive, terminated

    def position_info(self, state: State) -> Info:
        height = {"z_distance_from_origin": state.physics.qpos[1] - self.model.qpos0[1]}
        return super().position_info(state) | (height if self.options.version == "v5" else {})
