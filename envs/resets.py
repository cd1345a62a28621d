"""Distributions of initial states. Source: `reset_model` of the Gymnasium classes."""

import jax
from jax import Array
from jaxtyping import Float, PRNGKeyArray

__all__ = ["InitialState", "with_normal_velocity", "with_uniform_noise"]

InitialState = tuple[Float[Array, " nq"], Float[Array, " nv"]]
"""Position in m and rad, and velocity in m/s and rad/s."""


def with_uniform_noise(
    key: PRNGKeyArray, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], scale: float
) -> InitialState:
    """A pose with uniform noise in ±`scale` on positions and velocities."""
    qpos_key, qvel_key = jax.random.split(key)
    qpos_noise = jax.random.uniform(qpos_key, qpos.shape, minval=-scale, maxval=scale)
    qvel_noise = jax.random.uniform(qvel_key, qvel.shape, minval=-scale, maxval=scale)
    return qpos + qpos_noise, qvel + qvel_noise


def with_normal_velocity(
    key: PRNGKeyArray, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], scale: float
) -> InitialState:
    """A pose with uniform noise in ±`scale` on positions, and normal noise of that standard deviation on velocities."""
    qpos_key, qvel_key = jax.random.split(key)
    qpos_noise = jax.random.uniform(qpos_key, qpos.shape, minval=-scale, maxval=scale)
    return qpos + qpos_noise, qvel + scale * jax.random.normal(qvel_key, qvel.shape)
