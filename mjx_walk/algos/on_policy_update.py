"""What the updates of on-policy algorithms share: checks before, learning rates, and the state after."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import losses as ppo_losses

from mjx_walk.algos.on_policy import OnPolicyBatch, OnPolicyConfig, OnPolicyGround, OnPolicyState
from mjx_walk.common import returns
from mjx_walk.common.schedules import adapt_rate, factor
from mjx_walk.utils import collectives
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Algorithm, Metrics

Learn = Callable[[OnPolicyState, OnPolicyBatch], tuple[OnPolicyState, Metrics]]


def make_algorithm(ground: OnPolicyGround, learn: Learn) -> Algorithm:
    """An algorithm that takes only the scale of observations and rewards from its first batches, and then learns.

    The first batch is acted on without that scale. A policy that learns from it is another one under the scale: on
    Walker2d its KL from itself is 6 to 13.
    """

    def learn_once_measured(state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        learned, metrics = learn(state, batch)
        is_measuring = state.iterations < ground.num_warmup_batches
        old = (state.params, state.optimizer, state.learning_rate)
        new = (learned.params, learned.optimizer, learned.learning_rate)
        kept = jax.tree.map(lambda old, new: jnp.where(is_measuring, old, new), old, new)
        metrics = metrics | {
            name: jnp.where(is_measuring, jnp.nan, value) for name, value in metrics.items() if name not in batch.stats
        }
        return learned.replace(params=kept[0], optimizer=kept[1], learning_rate=kept[2]), metrics

    return Algorithm(
        ground.init,
        ground.collect,
        learn_once_measured,
        ground.policy_params,
        ground.policy,
        ground.steps_per_iteration,
    )


def learning_rates(config: OnPolicyConfig, state: OnPolicyState, remaining: jax.Array) -> ppo_losses.PPONetworkParams:
    """Those of policy and value network, under the schedule."""
    share = factor(config.learning_rate_schedule, remaining)
    return ppo_losses.PPONetworkParams(policy=state.learning_rate * share, value=config.learning_rate * share)


def after_update(
    config: OnPolicyConfig,
    state: OnPolicyState,
    batch: OnPolicyBatch,
    params: ppo_losses.PPONetworkParams,
    optimizer: optax.OptState,
    normalizer: RunningStatisticsState,
    kl: jax.Array,
    key: jax.Array,
) -> OnPolicyState:
    """`state` with what an update has changed, and a learning rate that follows the KL it ended at if it is to."""
    rate = state.learning_rate
    if config.learning_rate_schedule == "adaptive_kl":
        rate = adapt_rate(rate, collectives.mean(kl), config.target_kl)
    return state.replace(
        params=params,
        optimizer=optimizer,
        learning_rate=rate,
        normalizer=normalizer,
        return_scale=returns.update_return_scale(state.return_scale, batch.rewards, batch.ended, config.discount),
        key=key,
        iterations=state.iterations + 1,
    )


def require_several_gradient_steps(config: OnPolicyConfig, num_gradient_steps: int) -> None:
    """Check that a rate that is to adapt to the KL has one to adapt to.

    Raises:
        UserError: a batch's only gradient step is taken where the policy has not moved yet.
    """
    if config.learning_rate_schedule == "adaptive_kl" and num_gradient_steps == 1:
        raise UserError("algo.learning_rate_schedule=adaptive_kl needs algo.num_minibatches of 2 or more")


def require_whole_minibatches(num_envs: int, num_unrolls: int, num_minibatches: int) -> None:
    """Check that the pieces of a batch can be dealt out evenly.

    Raises:
        UserError: they cannot.
    """
    if num_envs * num_unrolls % num_minibatches:
        divisor = num_minibatches // math.gcd(num_minibatches, num_unrolls)
        raise UserError(
            f"num_envs={num_envs} times algo.num_unrolls={num_unrolls} does not divide into "
            f"algo.num_minibatches={num_minibatches}; choose num_envs a multiple of {divisor}"
        )
