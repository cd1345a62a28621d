"""How A2C and REINFORCE learn: a batch is gone through once, by the plain policy gradient."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState

from mjx_walk import networks
from mjx_walk.errors import UserError
from mjx_walk.on_policy import OnPolicyBatch, OnPolicyConfig, OnPolicyGround, OnPolicyState
from mjx_walk.optimizers import descend
from mjx_walk.schedules import adapt_rate, factor
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
        loss: `(params, normalizer, data of a minibatch, entropy cost, key)` to `(loss, metrics)`, among them `kl`.

    Returns:
        The state after it, and all metrics.

    Raises:
        UserError: a rate that adapts to the KL, of which a single gradient step knows nothing.
    """
    is_adaptive = config.learning_rate_schedule == "adaptive_kl"
    if is_adaptive and num_minibatches == 1:
        raise UserError("algo.learning_rate_schedule=adaptive_kl needs algo.num_minibatches of 2 or more")
    key, shuffle_key, loss_key = jax.random.split(state.key, 3)
    remaining = ground.remaining(state)
    rate_factor = factor(config.learning_rate_schedule, remaining)
    entropy_cost = config.entropy_cost * factor(config.entropy_schedule, remaining)
    # The policy that acted had the old normalizer, which its KL is to be measured under.
    new_normalizer = networks.update_normalizer(state.normalizer, batch.transitions.observation)
    normalizer = state.normalizer if is_adaptive else new_normalizer

    def minibatch(carry, inputs):
        params, opt_state, rate = carry
        rows, key = inputs
        part = jax.tree.map(lambda x: x[rows], data)
        grads, metrics = jax.grad(loss, has_aux=True)(params, normalizer, part, entropy_cost, key)
        metrics |= {"grad_norm": optax.global_norm(grads)}
        if is_adaptive:
            rate = adapt_rate(rate, metrics["kl"], config.target_kl)
        return (*descend(ground.optimizer, params, grads, opt_state, rate * rate_factor), rate), metrics

    rows = jax.random.permutation(shuffle_key, batch.transitions.reward.shape[0]).reshape((num_minibatches, -1))
    keys = jax.random.split(loss_key, num_minibatches)
    carry = (state.params, state.optimizer, state.learning_rate)
    (params, opt_state, rate), metrics = jax.lax.scan(minibatch, carry, (rows, keys))
    new_state = state.replace(
        params=params,
        optimizer=opt_state,
        learning_rate=rate,
        normalizer=new_normalizer,
        key=key,
        updates=state.updates + 1,
    )
    return new_state, batch.stats | jax.tree.map(jnp.mean, metrics) | {
        "learning_rate": jnp.float32(rate * rate_factor),
        "reward_scale": batch.reward_scale,
    }


def sampled_kl(log_prob: jax.Array, acted_log_prob: jax.Array) -> jax.Array:
    """KL of the policy from the one that acted, from the latter's own draws: `r - 1 - log r`, never below zero.

    Source: Schulman 2020, "Approximating KL divergence", the third estimator.
    """
    log_ratio = jnp.minimum(log_prob - acted_log_prob, 10.0)
    return (jnp.expm1(log_ratio) - log_ratio).mean()
