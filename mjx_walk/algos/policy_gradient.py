"""Base of A2C and REINFORCE: one pass over a batch with the plain policy gradient."""

import dataclasses
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.algos.on_policy import (
    OnPolicyAlgorithm,
    OnPolicyBatch,
    OnPolicyState,
    require_several_gradient_steps,
)
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.common.brax_losses import PPOParams
from mjx_walk.common.optimizers import schedule_factor
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import Losses, Metrics, as_means

__all__ = [
    "MAX_IMPORTANCE",
    "PolicyGradientAlgorithm",
    "PolicyGradientConfig",
    "Samples",
    "normalize",
    "out_of_bounds",
    "policy_gradient_loss",
    "sampled_kl",
]

MAX_IMPORTANCE = 10.0
"""Upper bound of importance weights."""


@dataclasses.dataclass
class PolicyGradientConfig(OnPolicyConfig):
    """Settings of A2C and REINFORCE."""

    distribution: str = setting("normal", choices=("tanh_normal", "normal"))
    """`tanh_normal` diverges here: nothing holds the mean back where tanh is flat."""
    mean_bound_coef: float = setting(1.0, at_least=0, only_if={"distribution": "normal"})
    """Coefficient of the squared distance of a `normal` distribution's mean from [-1, 1], where samples are clipped."""
    num_unrolls: int = setting(1, at_least=1, at_most=2**31 - 1)
    num_minibatches: int = setting(1, at_least=1)
    """Gradient steps on a batch, each on its own random share of the steps."""


class Samples(NamedTuple):
    """Steps to learn from, `[T, N, …]` or `[N, T, …]`; of a minibatch, `[S, …]`."""

    observation: Array
    raw_action: Array
    acted_log_prob: Array
    """Log-probability under the policy that acted."""
    advantage: Array
    weight: Array
    """0 for steps that do not count."""
    target: Array | tuple[()]
    """Target of the value network; empty where there is none."""


_PolicyGradientConfigT = TypeVar("_PolicyGradientConfigT", bound=PolicyGradientConfig)


@dataclasses.dataclass(frozen=True, eq=False)
class PolicyGradientAlgorithm(OnPolicyAlgorithm[_PolicyGradientConfigT]):
    """Uses each step of a batch for one gradient step. Subclasses define `samples`.

    Raises:
        UserError: fewer steps than minibatches; or see `require_several_gradient_steps`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        num_steps, num_minibatches = self.num_learned_steps, self.config.num_minibatches
        if num_steps < num_minibatches:
            raise UserError(f"algo.num_minibatches={num_minibatches} is more than the {num_steps} steps of a batch")
        require_several_gradient_steps(self.config, num_minibatches)

    @property
    def num_learned_steps(self) -> int:
        """Steps of a batch that are learned from."""
        return self.steps_per_iteration

    def samples(self, state: OnPolicyState, batch: OnPolicyBatch) -> Samples:
        """The steps of a batch, with their advantages."""
        raise NotImplementedError

    def value_loss(
        self, params: PPOParams, normalizer: RunningStatisticsState, samples: Samples
    ) -> tuple[Float[Array, ""], Losses]:
        """The loss of the value network, and metrics; zero where there is none."""
        return jnp.float32(0.0), {}

    def update(self, state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        return self.learn_once(state, batch, self.samples(state, batch))

    def learn_once(self, state: OnPolicyState, batch: OnPolicyBatch, samples: Samples) -> tuple[OnPolicyState, Metrics]:
        """One pass over the samples in minibatches, under the normalizer that acted.

        Up to `num_minibatches - 1` samples are left out.
        """
        key, shuffle_key, loss_key = jax.random.split(state.key, 3)
        remaining = self.remaining(state)
        rates = self.learning_rates(state, remaining)
        entropy_coef = self.config.entropy_coef * schedule_factor(self.config.entropy_schedule, remaining)

        def minibatch(carry, inputs):
            params, opt_state = carry
            rows, key = inputs
            part = jax.tree.map(lambda x: x[rows], samples)
            (total, metrics), grads = jax.value_and_grad(self.loss, has_aux=True)(
                params, state.normalizer, part, entropy_coef, key
            )
            metrics |= {"loss": total, "grad_norm": optax.tree.norm(grads)}
            return self.apply_gradients(params, grads, opt_state, rates), metrics

        samples = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), samples)
        num_minibatches = self.config.num_minibatches
        num_steps = samples.weight.size // num_minibatches * num_minibatches
        rows = jax.random.permutation(shuffle_key, samples.weight.size)[:num_steps].reshape((num_minibatches, -1))
        keys = jax.random.split(loss_key, num_minibatches)
        (params, optimizer), metrics = jax.lax.scan(minibatch, (state.params, state.optimizer), (rows, keys))
        normalizer = self.update_normalizer(state, batch)
        new_state = self.finish_update(state, batch, params, optimizer, normalizer, metrics["kl"][-1], key)
        return new_state, batch.metrics | as_means(
            jax.tree.map(jnp.mean, metrics)
            | {"learning_rate": jnp.float32(rates.policy), "reward_scale": batch.reward_scale}
        )

    def loss(
        self,
        params: PPOParams,
        normalizer: RunningStatisticsState,
        part: Samples,
        entropy_coef: Float[Array, ""] | float,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, ""], Losses]:
        """The loss of a minibatch, and metrics."""
        distribution = self.nets.parametric_action_distribution
        logits = self.nets.policy_network.apply(normalizer, params.policy, part.observation)
        log_prob = distribution.log_prob(logits, part.raw_action)
        entropy = distribution.entropy(logits, key).mean()
        losses = policy_gradient_loss(log_prob, part.acted_log_prob, part.advantage)
        policy_loss = (part.weight * losses).sum() / jnp.maximum(part.weight.sum(), 1.0)
        value_loss, metrics = self.value_loss(params, normalizer, part)
        metrics |= {"policy_loss": policy_loss, "entropy": entropy, "kl": sampled_kl(log_prob, part.acted_log_prob)}
        total = policy_loss + value_loss - entropy_coef * entropy
        if self.config.distribution == "normal":
            mean, _ = logits
            metrics["mean_out_of_bounds"] = out_of_bounds(mean)
            total += self.config.mean_bound_coef * metrics["mean_out_of_bounds"]
        return total, metrics


def policy_gradient_loss(
    log_prob: Float[Array, "*steps"], acted_log_prob: Float[Array, "*steps"], advantages: Float[Array, "*steps"]
) -> Float[Array, "*steps"]:
    """Minus the advantage times the log-probability, weighted by the action's importance weight.

    At the first gradient step of a batch the weight is 1. Without it, the gradient pushes a bad action away the harder
    the less likely that action already is, and a few steps move the policy far. A bound of 1, as in IMPALA, would leave
    a pull wherever advantages share a sign; this bound only guards against overflow.
    """
    weight = jax.lax.stop_gradient(jnp.minimum(jnp.exp(log_prob - acted_log_prob), MAX_IMPORTANCE))
    return -weight * advantages * log_prob


def out_of_bounds(mean: Float[Array, "*steps action_size"]) -> Float[Array, ""]:
    """Squared distance of means from [-1, 1], summed over an action, averaged over actions.

    Outside this range the samples are clipped, so no return depends on the mean, and it drifts.
    """
    return jnp.square(jnp.maximum(jnp.abs(mean) - 1.0, 0.0)).sum(axis=-1).mean()


def normalize(values: Float[Array, "*steps"], weight: Float[Array, "*steps"]) -> Float[Array, "*steps"]:
    """Values with mean 0 and standard deviation 1 over those that count."""
    total = jnp.maximum(weight.sum(), 1.0)
    centred = values - (weight * values).sum() / total
    return centred / jnp.sqrt((weight * centred**2).sum() / total + 1e-8)


def sampled_kl(log_prob: Float[Array, "*steps"], acted_log_prob: Float[Array, "*steps"]) -> Float[Array, ""]:
    """Estimate of the KL from the policy that acted, from its own samples: `r - 1 - log r`, never negative.

    Source: Schulman 2020, "Approximating KL divergence", the third estimator.
    """
    log_ratio = jnp.minimum(log_prob - acted_log_prob, 10.0)
    return (jnp.expm1(log_ratio) - log_ratio).mean()
