"""Proximal policy optimisation (Schulman et al. 2017) on Brax's networks and loss."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import optax
from brax.training.agents.ppo import losses as ppo_losses

from mjx_walk.algos.on_policy import OnPolicyBatch, OnPolicyConfig, OnPolicyState, make_on_policy
from mjx_walk.algos.on_policy_update import (
    after_update,
    learning_rates,
    make_algorithm,
    require_several_gradient_steps,
    require_whole_minibatches,
)
from mjx_walk.common import networks
from mjx_walk.common.optimizers import apply_gradients
from mjx_walk.common.schedules import factor
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm, Metrics


@dataclasses.dataclass
class PPOConfig(OnPolicyConfig):
    """Settings of PPO; the recipe of each task changes some of them."""

    name: str = setting("ppo", choices=("ppo",))
    num_minibatches: int = setting(32, at_least=1)
    num_epochs: int = setting(8, at_least=1)
    clip_epsilon: float = setting(0.3, above=0)


def make_ppo(task: Task, num_envs: int, evaluation: EvaluationConfig, config: PPOConfig) -> Algorithm:
    """Build PPO for a task.

    Args:
        task: the unbatched environment.
        num_envs: copies that learn.
        evaluation: of the policy beside them.
        config: settings.

    Raises:
        UserError: the batch does not divide into the minibatches; or see `require_several_gradient_steps`.
    """
    require_whole_minibatches(num_envs, config.num_unrolls, config.num_minibatches)
    require_several_gradient_steps(config, config.num_epochs * config.num_minibatches)
    ground = make_on_policy(task, num_envs, evaluation, config)
    nets = ground.nets

    def learn(state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        key, update_key = jax.random.split(state.key)
        remaining = ground.remaining(state)
        rates = learning_rates(config, state, remaining)
        new_normalizer = networks.update_normalizer(state.normalizer, batch.transitions.observation)
        # KL compares distributions under one normalizer, the one that acted.
        normalizer = state.normalizer if config.learning_rate_schedule == "adaptive_kl" else new_normalizer
        loss_fn = functools.partial(
            ppo_losses.compute_ppo_loss,
            ppo_network=nets,
            entropy_cost=config.entropy_coef * factor(config.entropy_schedule, remaining),
            discounting=config.discount,
            reward_scaling=batch.reward_scale,
            gae_lambda=config.gae_lambda,
            clipping_epsilon=config.clip_epsilon,
            normalize_advantage=config.normalize_advantages,
            vf_coefficient=config.value_loss_coef,
        )

        def minibatch(carry, rows):
            params, opt_state, key = carry
            key, loss_key = jax.random.split(key)
            data = jax.tree.map(lambda x: x[rows], batch.transitions)
            grads, metrics = jax.grad(loss_fn, has_aux=True)(params, normalizer, data, loss_key)
            metrics["grad_norm"] = optax.global_norm(grads)
            return (*apply_gradients(ground.optimizer, params, grads, opt_state, rates), key), metrics

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
        new_state = after_update(config, state, batch, params, optimizer, new_normalizer, kl, key)
        acted_with = batch.transitions.extras["policy_extras"]["distribution_params"]
        # The entropy is only told, so it may borrow the next update's key.
        return new_state, batch.stats | _loss_metrics(metrics) | {
            "entropy": nets.parametric_action_distribution.entropy(acted_with, key).mean(),
            "learning_rate": jnp.float32(rates.policy),
            "reward_scale": batch.reward_scale,
        }

    return make_algorithm(ground, learn)


def _loss_metrics(metrics: Metrics) -> Metrics:
    """Means over all minibatches, under our names."""
    names = {
        "total_loss": "loss",
        "policy_loss": "policy_loss",
        "v_loss": "value_loss",
        "kl_mean": "kl",
        "policy_dist_mean_std": "policy_std",
        "grad_norm": "grad_norm",
    }
    return {new: metrics[old].mean() for old, new in names.items()}
