"""Adam whose learning rate is an argument of every step, and schedules over environment steps."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float

from mjx_walk.utils import collectives
from mjx_walk.utils.types import PyTree

__all__ = [
    "adapt_rate",
    "anneal_discount",
    "apply_gradients",
    "make_adam",
    "polyak_update",
    "remaining_fraction",
    "schedule_factor",
]

_ParamsT = TypeVar("_ParamsT")


def make_adam(max_grad_norm: float | None = None) -> optax.GradientTransformation:
    """Adam without a learning rate, which `apply_gradients` takes; gradients are clipped by global norm if asked."""
    if max_grad_norm is None:
        return optax.scale_by_adam()
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.scale_by_adam())


def apply_gradients(
    optimizer: optax.GradientTransformation,
    params: _ParamsT,
    grads: _ParamsT,
    state: optax.OptState,
    learning_rate: PyTree,
    axis_name: str | None,
) -> tuple[_ParamsT, optax.OptState]:
    """One gradient step.

    Args:
        optimizer: from `make_adam`.
        params: parameters.
        grads: their gradients, averaged over the devices.
        state: optimizer state.
        learning_rate: one for all parameters, or a tree whose leaves stand for subtrees of `params`.
        axis_name: mapped axis over devices, if there is one.

    Returns:
        Parameters and optimizer state after the step.
    """
    updates, state = optimizer.update(collectives.mean(grads, axis_name), state)
    steps = jax.tree.map(lambda rate, part: jax.tree.map(lambda u: -rate * u, part), learning_rate, updates)
    return optax.apply_updates(params, steps), state


def polyak_update(target: _ParamsT, params: _ParamsT, tau: float) -> _ParamsT:
    """`(1 − τ) target + τ params`."""
    return jax.tree.map(lambda t, p: (1.0 - tau) * t + tau * p, target, params)


def remaining_fraction(steps: Float[Array, ""], horizon: int) -> Float[Array, ""]:
    """The fraction of a schedule that is left: 1 at the start, linearly to 0 at `horizon` steps, then 0."""
    return jnp.clip(1.0 - steps / float(horizon), 0.0, 1.0)  # as an integer, it might not fit into 32 bits


def schedule_factor(schedule: str, remaining: Float[Array, ""]) -> Float[Array, ""] | float:
    """The factor that a schedule gives a setting: 1 if it is `constant`, else the fraction that is left."""
    return 1.0 if schedule == "constant" else remaining


def anneal_discount(first: float, last: float | None, remaining: Float[Array, ""]) -> Float[Array, ""] | float:
    """A discount whose horizon 1 / (1 - γ) moves geometrically from the first to the last; constant without a last."""
    if last is None:
        return first
    return 1.0 - (1.0 - first) ** remaining * (1.0 - last) ** (1.0 - remaining)


def adapt_rate(rate: Float[Array, ""], kl: Float[Array, ""], target: float) -> Float[Array, ""]:
    """The learning rate that keeps the policy's KL from the acting policy near a target.

    Source: rsl_rl: ÷ 1.5 above twice the target, × 1.5 below half of it. Deviations: once a batch, not at each
    minibatch; bounds of 1e-6, not 1e-5, and 1e-2.
    """
    slower = jnp.where(kl > 2.0 * target, rate / 1.5, rate)
    faster = jnp.where((kl < 0.5 * target) & (kl > 0.0), slower * 1.5, slower)
    return jnp.clip(faster, 1e-6, 1e-2)
