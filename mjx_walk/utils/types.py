"""The few types that the trainer's parts exchange."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from brax.training.types import Transition

__all__ = ["Algorithm", "Metrics", "PolicyFn", "TrainState", "Transition"]

TrainState = Any
"""One pytree with everything that a run needs to go on exactly; each algorithm has its own.

All have the fields `env` (a `VectorState`), `key` and `updates`."""

Metrics = dict[str, jax.Array]
"""`[] f32` each, by the names they are logged under."""

PolicyFn = Callable[[jax.Array, jax.Array], jax.Array]
"""`(obs [B, observation_size], key) → action [B, action_size]`, in Gymnasium's units on both sides."""


class Algorithm(NamedTuple):
    """A learning algorithm as pure functions. `collect` holds no gradients and `learn` no physics."""

    init: Callable[[jax.Array], TrainState]
    """`key → TrainState`."""
    collect: Callable[[TrainState], tuple[TrainState, Any]]
    """Act and step all copies: `TrainState → (TrainState, batch)`."""
    learn: Callable[[TrainState, Any], tuple[TrainState, Metrics]]
    """Gradient steps on the batch: `(TrainState, batch) → (TrainState, metrics)`."""
    policy_params: Callable[[TrainState], Any]
    """The part of the TrainState that the policy needs, small enough to ship."""
    policy: Callable[..., PolicyFn]
    """`(policy_params, deterministic) → PolicyFn`."""
    steps_per_iteration: int
    """Environment steps, over all copies, of one `collect`."""
    replay_bytes: int = 0
    """Memory of the TrainState's field `replay`, where it has one."""
