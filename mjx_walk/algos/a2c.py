"""Advantage actor-critic (Mnih et al. 2016), synchronous: each step of many copies is learned from once."""

import dataclasses

import jax
import jax.numpy as jnp
from brax.training.agents.ppo import losses as ppo_losses

from mjx_walk.algos.on_policy import OnPolicyBatch, OnPolicyState, make_on_policy
from mjx_walk.algos.on_policy_update import make_algorithm
from mjx_walk.algos.policy_gradient import PolicyGradientConfig, Samples, check_minibatches, learn_once, normalize
from mjx_walk.common.exploration import OrnsteinUhlenbeck
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm, Metrics


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
    check_minibatches(num_envs * config.num_unrolls * config.unroll_length, config)
    exploration = OrnsteinUhlenbeck(config.ou_noise_std, config.ou_noise_theta) if config.ou_noise_std else None
    ground = make_on_policy(task, num_envs, evaluation, config, exploration=exploration)
    value_network = ground.nets.value_network

    def value_loss(params, normalizer, samples: Samples) -> tuple[jax.Array, Metrics]:
        values = value_network.apply(normalizer, params.value, samples.observation)
        loss = jnp.square(samples.target - values).mean()
        return config.value_loss_coef * loss, {"value_loss": loss}

    def learn(state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        """Source: Mnih et al. 2016, algorithm S3, with generalised advantages."""
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch.transitions)
        values = value_network.apply(state.normalizer, state.params.value, data.observation)
        targets, _ = ppo_losses.compute_gae(
            truncation=data.extras["state_extras"]["truncation"],
            termination=1.0 - data.discount,
            rewards=data.reward * batch.reward_scale,
            values=values,
            bootstrap_value=value_network.apply(state.normalizer, state.params.value, data.next_observation[0]),
            lambda_=config.gae_lambda,
            discount=config.discount,
        )
        # Not Brax's advantages, which look one step further ahead than λ says.
        advantages, weight = targets - values, jnp.ones_like(values)
        if config.normalize_advantages:
            advantages = normalize(advantages, weight)
        acted = data.extras["policy_extras"]
        samples = Samples(data.observation, acted["raw_action"], acted["log_prob"], advantages, weight, targets)
        return learn_once(ground, config, state, batch, samples, value_loss)

    return make_algorithm(ground, learn)
