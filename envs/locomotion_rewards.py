"""Reward of a robot that follows commanded velocities: named terms, and the quantities that they need."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from mjx_walk.envs.reward_shaping import Terms

__all__ = [
    "REWARD_TERMS",
    "LocomotionStep",
    "Weights",
    "beyond_limits",
    "has_fallen",
    "in_body_frame",
    "reward_terms",
]


@dataclasses.dataclass
class Weights:
    """Weights of the reward terms. Costs are negative; 0 disables a term."""

    linear_velocity: float = 1.0
    """`exp(-e² / velocity_scale)`, with the error e of the forward and sideways velocity, m/s."""
    angular_velocity: float = 0.5
    """`exp(-e² / velocity_scale)`, with the error e of the turning velocity, rad/s."""
    pose: float = 0.5
    """`exp(-4 d²)`, with the root mean square d of the servos' joints relative to the standing pose, rad."""
    vertical_velocity: float = -0.5
    """Squared vertical velocity of the torso, m²/s²."""
    roll_and_pitch: float = -0.05
    """Squared angular velocity of the torso about its horizontal axes, rad²/s²."""
    orientation: float = -5.0
    """Squared horizontal part of the torso's up-vector."""
    torques: float = -2e-4
    """Norm of the servos' torques, plus the sum of their absolute values, N·m."""
    action_rate: float = -0.01
    """Squared change of the action, in units of `action_scale`, summed over the servos."""
    air_time: float = 0.1
    """For each foot that touches down, its time in the air minus 0.1 s; none while the command is zero."""
    joint_limits: float = -1.0
    """Sum of the servos' joint angles beyond 95% of their range, rad."""
    termination: float = -1.0
    """1 in the step that ends the episode with a fall."""


REWARD_TERMS = tuple(f"reward_{field.name}" for field in dataclasses.fields(Weights))
"""Names of the terms, in the order of their weights."""

_POSE_SHARPNESS = 4.0
"""rad⁻². With a root mean square of 0.5 rad, the pose term is 1/e."""
_LEAST_AIR_TIME = 0.1
"""A step of a foot that is in the air for less costs, s."""
_SOFT_LIMIT = 0.95
"""Part of a joint's range inside which it costs nothing."""
_ZERO_COMMAND = 0.01
"""Commands below this norm ask the robot to stand."""


class LocomotionStep(NamedTuple):
    """Quantities on which the reward of one step depends."""

    command: Array
    """`[3] f32`: commanded forward, sideways and turning velocity, m/s, m/s and rad/s."""
    linear_velocity: Array
    """`[3] f32`: in the torso's frame, m/s."""
    angular_velocity: Array
    """`[3] f32`: in the torso's frame, rad/s."""
    vertical_velocity: Array
    """`[] f32`: in the world, m/s."""
    gravity: Array
    """`[3] f32`: direction of gravity in the torso's frame."""
    offsets: Array
    """`[servos] f32`: joint angles relative to the standing pose, rad."""
    beyond_limits: Array
    """`[servos] f32`: joint angles beyond the soft limits, rad."""
    torques: Array
    """`[servos] f32`, N·m."""
    action_change: Array
    """`[servos] f32`, in units of `action_scale`."""
    landed_air_time: Array
    """`[feet] f32`: time in the air of feet that touch down in this step, 0 for others, s."""
    has_landed: Array
    """`[feet] bool`: whether each foot touches down in this step."""
    has_fallen: Array
    """`[] bool`."""


def reward_terms(weights: Weights, velocity_scale: float, step: LocomotionStep) -> Terms:
    """Weighted terms of one step.

    Args:
        weights: of the terms.
        velocity_scale: of the velocity terms, m²/s² and rad²/s².
        step: the step.
    """
    linear_error = jnp.square(step.command[:2] - step.linear_velocity[:2]).sum()
    angular_error = jnp.square(step.command[2] - step.angular_velocity[2])
    is_commanded = jnp.linalg.norm(step.command) > _ZERO_COMMAND
    air_time = jnp.where(step.has_landed, step.landed_air_time - _LEAST_AIR_TIME, 0.0).sum()
    values = {
        "linear_velocity": jnp.exp(-linear_error / velocity_scale),
        "angular_velocity": jnp.exp(-angular_error / velocity_scale),
        "pose": jnp.exp(-_POSE_SHARPNESS * jnp.square(step.offsets).mean()),
        "vertical_velocity": jnp.square(step.vertical_velocity),
        "roll_and_pitch": jnp.square(step.angular_velocity[:2]).sum(),
        "orientation": jnp.square(step.gravity[:2]).sum(),
        "torques": jnp.linalg.norm(step.torques) + jnp.abs(step.torques).sum(),
        "action_rate": jnp.square(step.action_change).sum(),
        "air_time": air_time * is_commanded,
        "joint_limits": jnp.abs(step.beyond_limits).sum(),
        "termination": jnp.float32(step.has_fallen),
    }
    return {f"reward_{name}": jnp.float32(vars(weights)[name] * value) for name, value in values.items()}


def beyond_limits(
    angles: Float[Array, " servos"], low: Float[Array, " servos"], high: Float[Array, " servos"]
) -> Float[Array, " servos"]:
    """How far joint angles are beyond 95% of their range, rad. Below the range, the values are negative."""
    center, half = (low + high) / 2, _SOFT_LIMIT * (high - low) / 2
    return angles - jnp.clip(angles, center - half, center + half)


def in_body_frame(vector: Float[Array, "3"], quaternion: Float[Array, "4"]) -> Float[Array, "3"]:
    """A vector of the world in the frame of a body.

    Args:
        vector: in the world.
        quaternion: orientation of the body, w first; need not be normalized.
    """
    w, axis = quaternion[0], -quaternion[1:]
    twice = 2.0 * jnp.cross(axis, vector) / jnp.square(quaternion).sum()
    return vector + w * twice + jnp.cross(axis, twice)


def has_fallen(gravity: Float[Array, "3"], torso_height: Float[Array, ""], least_upright: float) -> Bool[Array, ""]:
    """Whether the torso is tilted too far, or touches the floor.

    Args:
        gravity: direction of gravity in the torso's frame.
        torso_height: of its lowest point above the floor, m.
        least_upright: cosine of the largest tilt.
    """
    return (-gravity[2] < least_upright) | (torso_height <= 0.0)
