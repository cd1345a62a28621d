"""Schedules over environment steps. `constant` is one; every other name stands for one that falls to zero."""

import jax
import jax.numpy as jnp


def anneal(steps: jax.Array, horizon: int) -> jax.Array:
    """The share of a schedule that is left: 1 at the start, linearly to 0 at `horizon` steps, then 0."""
    return jnp.clip(1.0 - steps / horizon, 0.0, 1.0)


def factor(schedule: str, remaining: jax.Array) -> jax.Array | float:
    """What a setting is to be multiplied by under its schedule, with `remaining` from `anneal`."""
    return 1.0 if schedule == "constant" else remaining
