"""Schedules over environment steps."""

import jax
import jax.numpy as jnp


def anneal(steps: jax.Array, horizon: int) -> jax.Array:
    """The share of a schedule that is left: 1 at the start, linearly to 0 at `horizon` steps, then 0."""
    return jnp.clip(1.0 - steps / horizon, 0.0, 1.0)
