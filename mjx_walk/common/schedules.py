"""Schedules over environment steps. `constant` is one; every other name stands for one that falls to zero."""

import jax
import jax.numpy as jnp


def anneal(steps: jax.Array, horizon: int) -> jax.Array:
    """The share of a schedule that is left: 1 at the start, linearly to 0 at `horizon` steps, then 0."""
    return jnp.clip(1.0 - steps / horizon, 0.0, 1.0)


def anneal_discount(first: float, last: float | None, remaining: jax.Array) -> jax.Array | float:
    """A discount whose horizon 1 / (1 - γ) goes from the first's to the last's, geometrically; none: it stays."""
    if last is None:
        return first
    return 1.0 - (1.0 - first) ** remaining * (1.0 - last) ** (1.0 - remaining)


def adapt_rate(rate: jax.Array, kl: jax.Array, target: float) -> jax.Array:
    """The learning rate that holds the policy's KL from the one that acted near a target.

    Source: rsl_rl: ÷ 1.5 above twice the target, × 1.5 below half of it. Deviations: once a batch, not at each
    minibatch; within 1e-6, not 1e-5, and 1e-2.
    """
    slower = jnp.where(kl > 2.0 * target, rate / 1.5, rate)
    faster = jnp.where((kl < 0.5 * target) & (kl > 0.0), slower * 1.5, slower)
    return jnp.clip(faster, 1e-6, 1e-2)


def factor(schedule: str, remaining: jax.Array) -> jax.Array | float:
    """What a setting is to be multiplied by under its schedule, with `remaining` from `anneal`."""
    return 1.0 if schedule == "constant" else remaining
