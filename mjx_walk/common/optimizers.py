"""Adam with a learning rate that the learner hands in at every step."""

from typing import Any

import jax
import optax

from mjx_walk.utils import collectives


def make_adam(max_grad_norm: float | None = None) -> optax.GradientTransformation:
    """Adam without its learning rate, which `apply_gradients` applies, after clipping by the global norm if asked."""
    if max_grad_norm is None:
        return optax.scale_by_adam()
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.scale_by_adam())


def apply_gradients(
    optimizer: optax.GradientTransformation, params: Any, grads: Any, state: optax.OptState, rate: Any
) -> tuple[Any, optax.OptState]:
    """One step down the gradient, its mean over the devices: `(params, optimizer state)` after it.

    `rate` is one for all parameters, or a tree of them whose leaves stand for subtrees of `params`.
    """
    updates, state = optimizer.update(collectives.mean(grads), state)
    steps = jax.tree.map(lambda rate, part: jax.tree.map(lambda u: -rate * u, part), rate, updates)
    return optax.apply_updates(params, steps), state


def move_towards(target: Any, params: Any, tau: float) -> Any:
    """Polyak averaging: `(1 − τ) target + τ params`."""
    return jax.tree.map(lambda t, p: (1.0 - tau) * t + tau * p, target, params)
