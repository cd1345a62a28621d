"""Advantage actor-critic (Mnih et al. 2016), synchronous: one gradient step on each batch, for many copies."""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from brax.training.agents.ppo import losses as ppo_losses

from mjx_walk import networks
from mjx_walk.envs import Task
from mjx_walk.live_evaluation import EvaluationConfig
from mjx_walk.on_policy import OnPolicyBatch, OnPolicyConfig, OnPolicyState, make_on_policy
from mjx_walk.optimizers import descend
from mjx_walk.schedules import factor
from mjx_walk.settings import setting
from mjx_walk.types import Algorithm, Metrics, Transition


@dataclasses.dataclass
class A2CConfig(OnPolicyConfig):
    """Settings of A2C; the recipe of each task changes some of them."""

    name: str = setting("a2c", choices=("a2c",))
    num_unrolls: int = setting(1, at_least=1)


def make_a2c(task: Task, num_envs: int, evaluation: EvaluationConfig, config: A2CConfig) -> Algorithm:
    """Build A2C for a task.

    Args:
        task: the unbatched environment.
        num_envs: copies that learn.
        evaluation: of the policy beside them.
        config: settings; `gae_lambda=0` gives the one-step temporal difference as advantage.
    """
    ground = make_on_policy(task, num_envs, evaluation, config)
    policy_network, value_network = ground.nets.policy_network, ground.nets.value_network
    distribution = ground.nets.parametric_action_distribution

    def loss(params, normalizer, data: Transition, reward_scale, entropy_cost, key):
        """Source: Mnih et al. 2016, algorithm S3, with generalised advantages. `data` is `[T, N, …]`."""
        logits = policy_network.apply(normalizer, params.policy, data.observation)
        values = value_network.apply(normalizer, params.value, data.observation)
        last_value = value_network.apply(normalizer, params.value, data.next_observation[0])
        targets, advantages = ppo_losses.compute_gae(
            truncation=data.extras["state_extras"]["truncation"],
            termination=1.0 - data.discount,
            rewards=data.reward * reward_scale,
            values=values,
            bootstrap_value=last_value,
            lambda_=config.gae_lambda,
            discount=config.discount,
        )
        if config.normalize_advantages:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        log_prob = distribution.log_prob(logits, data.extras["policy_extras"]["raw_action"])
        entropy = distribution.entropy(logits, key).mean()
        policy_loss = -(advantages * log_prob).mean()
        value_loss = jnp.square(targets - values).mean()
        total = policy_loss + config.value_cost * value_loss - entropy_cost * entropy
        return total, {"loss": total, "policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}

    def learn(state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        key, loss_key = jax.random.split(state.key)
        remaining = ground.remaining(state)
        rate = state.learning_rate * factor(config.learning_rate_schedule, remaining)
        entropy_cost = config.entropy_cost * factor(config.entropy_schedule, remaining)
        normalizer = networks.update_normalizer(state.normalizer, batch.transitions.observation)
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch.transitions)
        grads, metrics = jax.grad(loss, has_aux=True)(
            state.params, normalizer, data, batch.reward_scale, entropy_cost, loss_key
        )
        params, optimizer = descend(ground.optimizer, state.params, grads, state.optimizer, rate)
        new_state = state.replace(
            params=params, optimizer=optimizer, normalizer=normalizer, key=key, updates=state.updates + 1
        )
        return new_state, batch.stats | metrics | {
            "grad_norm": optax.global_norm(grads),
            "learning_rate": jnp.float32(rate),
            "reward_scale": batch.reward_scale,
        }

    return Algorithm(ground.init, ground.collect, learn, ground.policy_params, ground.policy, ground.steps_per_update)
