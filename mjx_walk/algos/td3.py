"""Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018) for many copies, on Brax's networks."""

import dataclasses
from typing import Any

import flax
import jax
import jax.numpy as jnp
import optax
from brax.training import types as brax_types

from mjx_walk.algos.off_policy import Batch, Learner, OffPolicyConfig, make_off_policy
from mjx_walk.common import networks
from mjx_walk.common.optimizers import apply_gradients, make_adam, move_towards
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm, Metrics


@dataclasses.dataclass
class DeterministicConfig(OffPolicyConfig):
    """Settings that TD3 and DDPG share."""

    min_exploration_noise: float = setting(0.1, at_least=0)
    """Std of the Gaussian noise on the first copy's actions, in the networks' `[-1, 1]`."""
    max_exploration_noise: float = setting(0.1, at_least=0)
    """On the last copy's; evenly spaced between, so that some copies explore and some stay near the policy."""


@dataclasses.dataclass
class TD3Config(DeterministicConfig):
    """Settings of TD3; the recipe of each task changes some of them."""

    name: str = setting("td3", choices=("td3",))
    policy_delay: int = setting(2, at_least=1)
    target_noise: float = setting(0.2, at_least=0)
    """Std of the noise that smooths the target policy, in the networks' `[-1, 1]`."""
    target_noise_clip: float = setting(0.5, at_least=0)


class TD3State(flax.struct.PyTreeNode):
    """Networks and optimizers."""

    policy: brax_types.Params
    critic: brax_types.Params
    target_policy: brax_types.Params
    target_critic: brax_types.Params
    policy_optimizer: optax.OptState
    critic_optimizer: optax.OptState


def make_td3(task: Task, num_envs: int, evaluation: EvaluationConfig, config: TD3Config) -> Algorithm:
    """Build TD3 for a task; see `make_off_policy`."""
    learner = make_deterministic_learner(task, num_envs, config, 2, config.target_noise, config.target_noise_clip)
    return make_off_policy(task, num_envs, evaluation, config, learner)


def make_deterministic_learner(
    task: Task,
    num_envs: int,
    config: DeterministicConfig,
    num_critics: int,
    target_noise: float,
    target_noise_clip: float,
) -> Learner:
    """A deterministic policy and `num_critics` critics, of which targets take the minimum.

    Source: Fujimoto et al. 2018, algorithm 1: both targets move when the policy does.
    """
    policy_network, critic_network = networks.make_deterministic_networks(task, config, num_critics)
    optimizer = make_adam(config.max_grad_norm)
    noise = jnp.linspace(config.min_exploration_noise, config.max_exploration_noise, num_envs)[:, None]

    def init(key: jax.Array) -> TD3State:
        policy_key, critic_key = jax.random.split(key)
        policy, critic = policy_network.init(policy_key), critic_network.init(critic_key)
        return TD3State(
            policy=policy,
            critic=critic,
            target_policy=policy,
            target_critic=critic,
            policy_optimizer=optimizer.init(policy),
            critic_optimizer=optimizer.init(critic),
        )

    def choose(policy_params: Any, obs: jax.Array) -> jax.Array:
        return jnp.tanh(policy_network.apply(None, policy_params, obs))

    def explore(policy_params: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
        action = choose(policy_params, obs)
        return jnp.clip(action + noise * jax.random.normal(key, action.shape), -1.0, 1.0)

    def act(policy_params: Any, obs: jax.Array, key: jax.Array, deterministic: bool = True) -> jax.Array:
        return choose(policy_params, obs) if deterministic else explore(policy_params, obs, key)

    def critic_target(state: TD3State, batch: Batch, key: jax.Array) -> jax.Array:
        data = batch.transitions
        action = choose(state.target_policy, data.next_observation)
        smoothing = target_noise * jax.random.normal(key, action.shape)
        action = jnp.clip(action + jnp.clip(smoothing, -target_noise_clip, target_noise_clip), -1.0, 1.0)
        values = critic_network.apply(None, state.target_critic, data.next_observation, action)
        return data.reward * batch.reward_scale + data.discount * values.min(axis=-1)

    def critic_loss(critic: Any, target: jax.Array, batch: Batch) -> tuple[jax.Array, jax.Array]:
        data = batch.transitions
        values = critic_network.apply(None, critic, data.observation, data.action)
        return jnp.square(values - target[:, None]).mean(axis=0).sum(), values.mean()

    def critic_update(state: TD3State, batch: Batch, key: jax.Array) -> tuple[TD3State, Metrics]:
        target = critic_target(state, batch, key)
        (loss, value), grads = jax.value_and_grad(critic_loss, has_aux=True)(state.critic, target, batch)
        rate = config.critic_learning_rate * batch.rate_factor
        critic, critic_optimizer = apply_gradients(optimizer, state.critic, grads, state.critic_optimizer, rate)
        metrics = {"critic_loss": loss, "critic_value": value, "critic_grad_norm": optax.global_norm(grads)}
        return state.replace(critic=critic, critic_optimizer=critic_optimizer), metrics

    def policy_loss(policy: Any, critic: Any, batch: Batch) -> jax.Array:
        obs = batch.transitions.observation
        action = choose(policy, obs)
        return -critic_network.apply(None, critic, obs, action)[:, 0].mean()

    def full_update(state: TD3State, batch: Batch, key: jax.Array) -> tuple[TD3State, Metrics]:
        state, metrics = critic_update(state, batch, key)
        loss, grads = jax.value_and_grad(policy_loss)(state.policy, state.critic, batch)
        rate = config.policy_learning_rate * batch.rate_factor
        policy, policy_optimizer = apply_gradients(optimizer, state.policy, grads, state.policy_optimizer, rate)
        state = state.replace(
            policy=policy,
            policy_optimizer=policy_optimizer,
            target_policy=move_towards(state.target_policy, policy, config.tau),
            target_critic=move_towards(state.target_critic, state.critic, config.tau),
        )
        return state, metrics | {"policy_loss": loss}

    return Learner(init, lambda state: state.policy, explore, act, critic_update, full_update)
