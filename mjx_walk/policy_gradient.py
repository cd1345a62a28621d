"""How A2C and REINFORCE learn: a batch is gone through once, by the plain policy gradient."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState

from mjx_walk import networks
from mjx_walk.on_policy import OnPolicyBatch, OnPolicyConfig, OnPolicyGround, OnPolicyState
from mjx_walk.optimizers import descend
from mjx_walk.schedules import factor
from mjx_walk.types import Metrics


def learn_once(
    ground: OnPolicyGround,
    config: OnPolicyConfig,
    state: OnPolicyState,
    batch: OnPolicyBatch,
    data: Any,
    num_minibatches: int,
    loss: Callable[[Any, RunningStatisticsState, Any, jax.Array, jax.Array], tuple[jax.Array, Metrics]],
) -> tuple[OnPolicyState, Metrics]:
    """One pass over a batch in minibatches, each piece used for one gradient step.

    Args:
        ground: of the algorithm.
        config: settings.
        state: before.
        batch: as collected.
        data: what the loss reads of it; a tree of `[N, …]`.
        num_minibatches: gradient steps.
        loss: `(params, normalizer, data of a minibatch, entropy cost, key)` to `(loss, metrics)`.

    Returns:
        The state after it, and all metrics.
    """
    key, shuffle_key, loss_key = jax.random.split(state.key, 3)
    remaining = ground.remaining(state)
    rate = state.learning_rate * factor(config.learning_rate_schedule, remaining)
    entropy_cost = config.entropy_cost * factor(config.entropy_schedule, remaining)
    normalizer = networks.update_normalizer(state.normalizer, batch.transitions.observation)

    def minibatch(carry, inputs):
        params, opt_state = carry
        rows, key = inputs
        part = jax.tree.map(lambda x: x[rows], data)
        grads, metrics = jax.grad(loss, has_aux=True)(params, normalizer, part, entropy_cost, key)
        metrics |= {"grad_norm": optax.global_norm(grads)}
        return descend(ground.optimizer, params, grads, opt_state, rate), metrics

    rows = jax.random.permutation(shuffle_key, batch.transitions.reward.shape[0]).reshape((num_minibatches, -1))
    keys = jax.random.split(loss_key, num_minibatches)
    (params, opt_state), metrics = jax.lax.scan(minibatch, (state.params, state.optimizer), (rows, keys))
    new_state = state.replace(
        params=params, optimizer=opt_state, normalizer=normalizer, key=key, updates=state.updates + 1
    )
    return new_state, batch.stats | jax.tree.map(jnp.mean, metrics) | {
        "learning_rate": jnp.float32(rate),
        "reward_scale": batch.reward_scale,
    }
