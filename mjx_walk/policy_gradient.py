"""How A2C and REINFORCE learn: a batch is gone through once, by the plain policy gradient."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState

from mjx_walk import networks
from mjx_walk.errors import UserError
from mjx_walk.on_policy import (
    OnPolicyBatch,
    OnPolicyConfig,
    OnPolicyGround,
    OnPolicyState,
    after_update,
    learning_rates,
    require_whole_minibatches,
)
from mjx_walk.optimizers import descend
from mjx_walk.schedules import factor
from mjx_walk.settings import setting
from mjx_walk.types import Metrics


@dataclasses.dataclass
class PolicyGradientConfig(OnPolicyConfig):
    """Settings that both have."""

    distribution: str = setting("normal", choices=("tanh_normal", "normal"))
    """Squashed, it runs away: nothing holds the mean back where tanh is flat."""
    num_unrolls: int = setting(1, at_least=1)
    num_minibatches: int = setting(1, at_least=1)
    """Gradient steps on a batch, each on pieces of its own."""


def check_minibatches(num_envs: int, config: PolicyGradientConfig) -> None:
    """Check that a batch can be learned from as the settings say.

    Raises:
        UserError: its pieces do not divide into the minibatches; or the rate is to adapt to the KL, of which a single
            gradient step knows nothing.
    """
    require_whole_minibatches(num_envs, config.num_unrolls, config.num_minibatches)
    if config.learning_rate_schedule == "adaptive_kl" and config.num_minibatches == 1:
        raise UserError("algo.learning_rate_schedule=adaptive_kl needs algo.num_minibatches of 2 or more")


def learn_once(
    ground: OnPolicyGround,
    config: PolicyGradientConfig,
    state: OnPolicyState,
    batch: OnPolicyBatch,
    data: Any,
    loss: Callable[[Any, RunningStatisticsState, Any, jax.Array, jax.Array], tuple[jax.Array, Metrics]],
) -> tuple[OnPolicyState, Metrics]:
    """One pass over a batch in minibatches, each piece used for one gradient step, under the normalizer that acted.

    Args:
        ground: of the algorithm.
        config: settings.
        state: before.
        batch: as collected.
        data: what the loss reads of it; a tree of `[N, …]`.
        loss: `(params, normalizer, data of a minibatch, entropy cost, key)` to `(loss, metrics)`, among them `kl`.

    Returns:
        The state after it, and all metrics.
    """
    key, shuffle_key, loss_key = jax.random.split(state.key, 3)
    remaining = ground.remaining(state)
    rates = learning_rates(config, state, remaining)
    entropy_cost = config.entropy_cost * factor(config.entropy_schedule, remaining)

    def minibatch(carry, inputs):
        params, opt_state = carry
        rows, key = inputs
        part = jax.tree.map(lambda x: x[rows], data)
        grads, metrics = jax.grad(loss, has_aux=True)(params, state.normalizer, part, entropy_cost, key)
        metrics |= {"grad_norm": optax.global_norm(grads)}
        return descend(ground.optimizer, params, grads, opt_state, rates), metrics

    rows = jax.random.permutation(shuffle_key, batch.transitions.reward.shape[0]).reshape((config.num_minibatches, -1))
    keys = jax.random.split(loss_key, config.num_minibatches)
    (params, optimizer), metrics = jax.lax.scan(minibatch, (state.params, state.optimizer), (rows, keys))
    normalizer = networks.update_normalizer(state.normalizer, batch.transitions.observation)
    new_state = after_update(config, state, params, optimizer, normalizer, metrics["kl"][-1], key)
    return new_state, batch.stats | jax.tree.map(jnp.mean, metrics) | {
        "learning_rate": jnp.float32(rates.policy),
        "reward_scale": batch.reward_scale,
    }


def policy_gradient_loss(log_prob: jax.Array, acted_log_prob: jax.Array, advantages: jax.Array) -> jax.Array:
    """Minus the advantages times the log-probability, `[…]`, weighted by how much less likely the action has become.

    At a batch's first gradient step the weight is 1. Without it, an action to be avoided is pushed away the harder the
    less likely it already is, and a few steps on one batch leave its policy far behind.

    Source: Espeholt et al. 2018 (IMPALA), truncated importance weights with a bound of 1.
    """
    weight = jax.lax.stop_gradient(jnp.exp(jnp.minimum(log_prob - acted_log_prob, 0.0)))
    return -weight * advantages * log_prob


def sampled_kl(log_prob: jax.Array, acted_log_prob: jax.Array) -> jax.Array:
    """KL of the policy from the one that acted, from the latter's own draws: `r - 1 - log r`, never below zero.

    Source: Schulman 2020, "Approximating KL divergence", the third estimator.
    """
    log_ratio = jnp.minimum(log_prob - acted_log_prob, 10.0)
    return (jnp.expm1(log_ratio) - log_ratio).mean()
