"""Proximal policy optimization (Schulman et al. 2017) on Brax's networks and loss."""

import dataclasses
import functools
import math

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
from mjx_walk.common.brax_losses import PPOParams, make_ppo_loss
from mjx_walk.common.optimizers import schedule_factor
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import Losses, Metrics, Transition, as_means

__all__ = ["PPO", "PPOConfig"]


@dataclasses.dataclass
class PPOConfig(OnPolicyConfig):
    """Settings of PPO."""

    name: str = setting("ppo", choices=("ppo",))
    num_minibatches: int = setting(32, at_least=1)
    """Minibatches of one epoch, with one gradient step each."""
    num_epochs: int = setting(8, at_least=1, search="interval(3,12)")
    """Passes over one batch."""
    clip_epsilon: float = setting(0.3, above=0, search="0.1,0.2,0.3")
    """Largest change of the probability ratio from 1, ε."""


@dataclasses.dataclass(frozen=True, eq=False)
class PPO(OnPolicyAlgorithm[PPOConfig]):
    """Several epochs of minibatches on Brax's clipped loss.

    Deviation: Brax's loss estimates and normalizes advantages in every minibatch, with the current value network.

    Raises:
        UserError: the batch cannot be split evenly into minibatches; or see `require_several_gradient_steps`.
    """

    def __post_init__(self) -> None:
        _require_even_minibatches(self.num_envs, self.config.num_unrolls, self.config.num_minibatches)
        require_several_gradient_steps(self.config, self.config.num_epochs * self.config.num_minibatches)
        super().__post_init__()

    def loss(
        self,
        params: PPOParams,
        normalizer: RunningStatisticsState,
        transitions: Transition,
        key: PRNGKeyArray,
        entropy_coef: Float[Array, ""] | float,
        reward_scale: Float[Array, ""],
    ) -> tuple[Float[Array, ""], Losses]:
        """The loss of a minibatch `[N, T, …]`, and Brax's metrics. `docs/algorithms/ppo.md` has the formula."""
        brax_loss = make_ppo_loss(self.nets, self.config, entropy_coef, reward_scale)
        return brax_loss(params, normalizer, transitions, key)

    def update(self, state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        config = self.config
        key, update_key = jax.random.split(state.key)
        remaining = self.remaining(state)
        rates = self.learning_rates(state, remaining)
        new_normalizer = self.update_normalizer(state, batch)
        # KL compares distributions under one normalizer, the one that acted.
        normalizer = state.normalizer if config.learning_rate_schedule == "adaptive_kl" else new_normalizer
        entropy_coef = config.entropy_coef * schedule_factor(config.entropy_schedule, remaining)
        loss_fn = functools.partial(self.loss, entropy_coef=entropy_coef, reward_scale=batch.reward_scale)

        def minibatch(carry, rows):
            params, opt_state, key = carry
            key, loss_key = jax.random.split(key)
            data = jax.tree.map(lambda x: x[rows], batch.transitions)
            grads, metrics = jax.grad(loss_fn, has_aux=True)(params, normalizer, data, loss_key)
            metrics["grad_norm"] = optax.tree.norm(grads)
            return (*self.apply_gradients(params, grads, opt_state, rates), key), metrics

        def epoch(carry, _):
            params, opt_state, key = carry
            key, shuffle_key, epoch_key = jax.random.split(key, 3)
            rows = jax.random.permutation(shuffle_key, batch.transitions.reward.shape[0])
            carry = (params, opt_state, epoch_key)
            (params, opt_state, _), metrics = jax.lax.scan(minibatch, carry, rows.reshape((config.num_minibatches, -1)))
            return (params, opt_state, key), metrics

        carry = (state.params, state.optimizer, update_key)
        (params, optimizer, _), metrics = jax.lax.scan(epoch, carry, length=config.num_epochs)
        kl = metrics["kl_mean"][-1, -1]
        new_state = self.finish_update(state, batch, params, optimizer, new_normalizer, kl, key)
        acted_with = batch.transitions.extras["policy_extras"]["distribution_params"]
        return new_state, batch.metrics | as_means(
            _loss_metrics(metrics)
            | {
                # Only logged, so it may reuse the key of the next iteration.
                "entropy": self.nets.parametric_action_distribution.entropy(acted_with, key).mean(),
                "learning_rate": jnp.float32(rates.policy),
                "reward_scale": batch.reward_scale,
            }
        )


def _loss_metrics(metrics: dict[str, Float[Array, "epochs minibatches"]]) -> Losses:
    """Means of Brax's metrics over all minibatches, under our names."""
    names = {
        "total_loss": "loss",
        "policy_loss": "policy_loss",
        "v_loss": "value_loss",
        "kl_mean": "kl",
        "policy_dist_mean_std": "policy_std",
        "grad_norm": "grad_norm",
    }
    return {new: metrics[old].mean() for old, new in names.items()}


def _require_even_minibatches(num_envs: int, num_unrolls: int, num_minibatches: int) -> None:
    """Check that the unrolls of a batch can be split evenly.

    Raises:
        UserError: they cannot.
    """
    if num_envs * num_unrolls % num_minibatches:
        divisor = num_minibatches // math.gcd(num_minibatches, num_unrolls)
        raise UserError(
            f"num_envs={num_envs} times algo.num_unrolls={num_unrolls} must be a multiple of "
            f"algo.num_minibatches={num_minibatches}; choose num_envs a multiple of {divisor}"
        )
