"""How A2C and REINFORCE learn: a batch is gone through once, by the plain policy gradient."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState

from mjx_walk.algos.on_policy import OnPolicyBatch, OnPolicyConfig, OnPolicyGround, OnPolicyState
from mjx_walk.algos.on_policy_update import after_update, learning_rates, require_several_gradient_steps
from mjx_walk.common import networks
from mjx_walk.common.optimizers import apply_gradients
from mjx_walk.common.schedules import factor
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Metrics


@dataclasses.dataclass
class PolicyGradientConfig(OnPolicyConfig):
    """Settings that both have."""

    distribution: str = setting("normal", choices=("tanh_normal", "normal"))
    """Squashed, it runs away: nothing holds the mean back where tanh is flat."""
    mean_bound_coef: float = setting(1.0, at_least=0)
    """Of the squared distance by which a `normal` distribution's mean leaves [-1, 1], where its samples are clipped."""
    num_unrolls: int = setting(1, at_least=1)
    num_minibatches: int = setting(1, at_least=1)
    """Gradient steps on a batch, each on steps of its own, drawn from all pieces."""


def check_minibatches(num_steps: int, config: PolicyGradientConfig) -> None:
    """Check that a batch of `num_steps` steps can be learned from as the settings say.

    Raises:
        UserError: there are fewer than minibatches; or see `require_several_gradient_steps`.
    """
    if num_steps < config.num_minibatches:
        raise UserError(f"algo.num_minibatches={config.num_minibatches} is more than the {num_steps} steps of a batch")
    require_several_gradient_steps(config, config.num_minibatches)


class Samples(NamedTuple):
    """Steps of a batch that are learned from, `[T, N, …]` or `[N, T, …]`; of a minibatch, `[S, …]`."""

    observation: jax.Array
    raw_action: jax.Array
    acted_log_prob: jax.Array
    """Of the policy that acted."""
    advantage: jax.Array
    weight: jax.Array
    """0 for steps that do not count."""
    target: jax.Array | tuple[()]
    """For the value network; empty where there is none."""


def learn_once(
    ground: OnPolicyGround,
    config: PolicyGradientConfig,
    state: OnPolicyState,
    batch: OnPolicyBatch,
    samples: Samples,
    value_loss: Callable[[Any, RunningStatisticsState, Samples], tuple[jax.Array, Metrics]],
) -> tuple[OnPolicyState, Metrics]:
    """One pass over a batch in minibatches, each step used for one gradient step, under the normalizer that acted.

    Args:
        ground: of the algorithm.
        config: settings.
        state: before.
        batch: as collected.
        samples: of the batch; up to `num_minibatches - 1` are left over.
        value_loss: `(params, normalizer, minibatch) → (loss to be added, metrics)`.

    Returns:
        The state after it, and all metrics.
    """
    key, shuffle_key, loss_key = jax.random.split(state.key, 3)
    remaining = ground.remaining(state)
    rates = learning_rates(config, state, remaining)
    entropy_coef = config.entropy_coef * factor(config.entropy_schedule, remaining)

    distribution = ground.nets.parametric_action_distribution

    def loss(params, part: Samples, key):
        logits = ground.nets.policy_network.apply(state.normalizer, params.policy, part.observation)
        log_prob = distribution.log_prob(logits, part.raw_action)
        entropy = distribution.entropy(logits, key).mean()
        losses = policy_gradient_loss(log_prob, part.acted_log_prob, part.advantage)
        policy_loss = (part.weight * losses).sum() / jnp.maximum(part.weight.sum(), 1.0)
        further_loss, metrics = value_loss(params, state.normalizer, part)
        metrics |= {"policy_loss": policy_loss, "entropy": entropy, "kl": sampled_kl(log_prob, part.acted_log_prob)}
        total = policy_loss + further_loss - entropy_coef * entropy
        if config.distribution == "normal":
            mean, _ = logits
            metrics["mean_out_of_bounds"] = out_of_bounds(mean)
            total += config.mean_bound_coef * metrics["mean_out_of_bounds"]
        return total, metrics

    def minibatch(carry, inputs):
        params, opt_state = carry
        rows, key = inputs
        part = jax.tree.map(lambda x: x[rows], samples)
        (total, metrics), grads = jax.value_and_grad(loss, has_aux=True)(params, part, key)
        metrics |= {"loss": total, "grad_norm": optax.global_norm(grads)}
        return apply_gradients(ground.optimizer, params, grads, opt_state, rates), metrics

    samples = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), samples)
    num_steps = samples.weight.size // config.num_minibatches * config.num_minibatches
    rows = jax.random.permutation(shuffle_key, samples.weight.size)[:num_steps].reshape((config.num_minibatches, -1))
    keys = jax.random.split(loss_key, config.num_minibatches)
    (params, optimizer), metrics = jax.lax.scan(minibatch, (state.params, state.optimizer), (rows, keys))
    normalizer = networks.update_normalizer(state.normalizer, batch.transitions.observation)
    new_state = after_update(config, state, batch, params, optimizer, normalizer, metrics["kl"][-1], key)
    return new_state, batch.stats | jax.tree.map(jnp.mean, metrics) | {
        "learning_rate": jnp.float32(rates.policy),
        "reward_scale": batch.reward_scale,
    }


_MAX_IMPORTANCE = 10.0


def policy_gradient_loss(log_prob: jax.Array, acted_log_prob: jax.Array, advantages: jax.Array) -> jax.Array:
    """Minus the advantages times the log-probability, `[…]`, weighted by how much likelier the action has become.

    At a batch's first gradient step the weight is 1. Without it, an action to be avoided is pushed away the harder the
    less likely it already is, and a few steps on one batch leave its policy far behind. A bound of 1, as in IMPALA,
    would leave a pull wherever advantages share a sign; this one only guards against what a float cannot hold.
    """
    weight = jax.lax.stop_gradient(jnp.minimum(jnp.exp(log_prob - acted_log_prob), _MAX_IMPORTANCE))
    return -weight * advantages * log_prob


def out_of_bounds(mean: jax.Array) -> jax.Array:
    """The squared distance of means, `[…, action_size]`, from [-1, 1], summed over an action and averaged.

    Outside, the noise is clipped away, so that no return depends on it: the means only drift, ever further out, and
    with them goes what there was to learn from.
    """
    return jnp.square(jnp.maximum(jnp.abs(mean) - 1.0, 0.0)).sum(axis=-1).mean()


def normalize(values: jax.Array, weight: jax.Array) -> jax.Array:
    """To mean 0 and std 1 over what counts."""
    total = jnp.maximum(weight.sum(), 1.0)
    centred = values - (weight * values).sum() / total
    return centred / jnp.sqrt((weight * centred**2).sum() / total + 1e-8)


def sampled_kl(log_prob: jax.Array, acted_log_prob: jax.Array) -> jax.Array:
    """KL of the policy from the one that acted, from the latter's own draws: `r - 1 - log r`, never below zero.

    Source: Schulman 2020, "Approximating KL divergence", the third estimator.
    """
    log_ratio = jnp.minimum(log_prob - acted_log_prob, 10.0)
    return (jnp.expm1(log_ratio) - log_ratio).mean()
