"""Advantage actor-critic (Mnih et al. 2016), synchronous: each step of many copies is learned from once."""

import dataclasses

import jax
import jax.numpy as jnp
from brax.training.agents.ppo import losses as ppo_losses

from mjx_walk.envs import Task
from mjx_walk.live_evaluation import EvaluationConfig
from mjx_walk.noise import OrnsteinUhlenbeck
from mjx_walk.on_policy import OnPolicyBatch, OnPolicyState, make_on_policy
from mjx_walk.policy_gradient import (
    PolicyGradientConfig,
    check_minibatches,
    learn_once,
    policy_gradient_loss,
    sampled_kl,
)
from mjx_walk.settings import setting
from mjx_walk.types import Algorithm, Metrics


@dataclasses.dataclass
class A2CConfig(PolicyGradientConfig):
    """Settings of A2C; the recipe of each task changes some of them."""

    name: str = setting("a2c", choices=("a2c",))
    ou_noise_std: float = setting(0.0, at_least=0)
    """Ornstein-Uhlenbeck noise added to actions in [-1, 1]: the std of its kicks."""
    ou_noise_theta: float = setting(0.15, above=0, at_most=1)
    """The share of it that is lost at every step."""


def make_a2c(task: Task, num_envs: int, evaluation: EvaluationConfig, config: A2CConfig) -> Algorithm:
    """Build A2C for a task.

    Args:
        task: the unbatched environment.
        num_envs: copies that learn.
        evaluation: of the policy beside them.
        config: settings; `gae_lambda=0` gives the one-step temporal difference as advantage.

    Raises:
        UserError: see `check_minibatches`.
    """
    check_minibatches(num_envs, config)
    exploration = OrnsteinUhlenbeck(config.ou_noise_std, config.ou_noise_theta) if config.ou_noise_std else None
    ground = make_on_policy(task, num_envs, evaluation, config, exploration=exploration)
    policy_network, value_network = ground.nets.policy_network, ground.nets.value_network
    distribution = ground.nets.parametric_action_distribution

    def loss(params, normalizer, data, entropy_cost, key):
        """Source: Mnih et al. 2016, algorithm S3, with generalised advantages. `data` is `[N, T, …]`."""
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)
        logits = policy_network.apply(normalizer, params.policy, data.observation)
        values = value_network.apply(normalizer, params.value, data.observation)
        last_value = value_network.apply(normalizer, params.value, data.next_observation[0])
        targets, _ = ppo_losses.compute_gae(
            truncation=data.extras["state_extras"]["truncation"],
            termination=1.0 - data.discount,
            rewards=data.reward,
            values=values,
            bootstrap_value=last_value,
            lambda_=config.gae_lambda,
            discount=config.discount,
        )
        # Not Brax's advantages, which look one step further ahead than λ says.
        advantages = jax.lax.stop_gradient(targets - values)
        if config.normalize_advantages:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        log_prob = distribution.log_prob(logits, data.extras["policy_extras"]["raw_action"])
        entropy = distribution.entropy(logits, key).mean()
        acted_log_prob = data.extras["policy_extras"]["log_prob"]
        policy_loss = policy_gradient_loss(log_prob, acted_log_prob, advantages).mean()
        value_loss = jnp.square(targets - values).mean()
        total = policy_loss + config.value_cost * value_loss - entropy_cost * entropy
        metrics = {"loss": total, "policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
        return total, metrics | {"kl": sampled_kl(log_prob, acted_log_prob)}

    def learn(state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        data = batch.transitions._replace(reward=batch.transitions.reward * batch.reward_scale)
        return learn_once(ground, config, state, batch, data, loss)

    return Algorithm(ground.init, ground.collect, learn, ground.policy_params, ground.policy, ground.steps_per_update)
