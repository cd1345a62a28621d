"""Soft actor-critic (Haarnoja et al. 2018) on Brax's networks and losses."""

import dataclasses
from collections.abc import Callable
from typing import Any

import flax
import jax
import jax.numpy as jnp
import optax
from brax.training import types as brax_types
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac.networks import SACNetworks

from mjx_walk.algos.off_policy import Batch, Learner, OffPolicyConfig, make_off_policy
from mjx_walk.common import networks
from mjx_walk.common.optimizers import apply_gradients, make_adam, move_towards
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm, Metrics

MakeCriticLoss = Callable[[jax.Array], Callable[..., jax.Array]]


@dataclasses.dataclass
class SACConfig(OffPolicyConfig):
    """Settings of SAC; the recipe of each task changes some of them."""

    name: str = setting("sac", choices=("sac",))
    init_alpha: float = setting(1.0, above=0)
    """The temperature to begin with."""
    alpha_learning_rate: float = setting(3e-4, above=0)
    target_entropy: float = setting(-0.5, below=0.69)
    """That the temperature keeps the policy at, in nats per action dimension; Brax's is -0.5. Actions lie in `[-1, 1]`,
    so that none have more than ln 2, and a temperature that waits for more grows without end."""
    final_target_entropy: float | None = setting(None, below=0.69)
    """What it becomes, linearly over `schedule_steps`."""


class SACState(flax.struct.PyTreeNode):
    """Networks and optimizers."""

    policy: brax_types.Params
    critic: brax_types.Params
    target_critic: brax_types.Params
    log_alpha: jax.Array
    policy_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    alpha_optimizer: optax.OptState


def make_sac(task: Task, num_envs: int, evaluation: EvaluationConfig, config: SACConfig) -> Algorithm:
    """Build SAC for a task; see `make_off_policy`."""
    return make_off_policy(task, num_envs, evaluation, config, make_sac_learner(task, config))


def make_sac_learner(
    task: Task, config: SACConfig, nets: SACNetworks | None = None, make_critic_loss: MakeCriticLoss | None = None
) -> Learner:
    """SAC's networks and updates.

    Source: `sgd_step` of Brax's SAC: temperature, critic and policy take their gradients at the same, old parameters.

    Args:
        task: gives the sizes.
        config: settings.
        nets: other networks than Brax's.
        make_critic_loss: another loss than Brax's, given the reward scale; called as Brax's is.
    """
    nets = nets or networks.make_sac_networks(task, config)
    optimizer = make_adam(config.max_grad_norm)
    last_entropy = config.target_entropy if config.final_target_entropy is None else config.final_target_entropy

    def losses(batch: Batch):
        entropy = last_entropy + (config.target_entropy - last_entropy) * batch.remaining
        # Brax's only use of the size is a target entropy of -0.5 nats for each action dimension.
        entropy_size = -2.0 * entropy * task.action_size
        # γ is in the batch's discounts.
        return sac_losses.make_losses(nets, batch.reward_scale, discounting=1.0, action_size=entropy_size)

    def init(key: jax.Array) -> SACState:
        policy_key, critic_key = jax.random.split(key)
        policy, critic = nets.policy_network.init(policy_key), nets.q_network.init(critic_key)
        log_alpha = jnp.log(jnp.float32(config.init_alpha))
        return SACState(
            policy=policy,
            critic=critic,
            target_critic=critic,
            log_alpha=log_alpha,
            policy_optimizer=optimizer.init(policy),
            critic_optimizer=optimizer.init(critic),
            alpha_optimizer=optimizer.init(log_alpha),
        )

    def act(policy_params: Any, obs: jax.Array, key: jax.Array, deterministic: bool = False) -> jax.Array:
        logits = nets.policy_network.apply(None, policy_params, obs)
        distribution = nets.parametric_action_distribution
        return distribution.mode(logits) if deterministic else distribution.sample(logits, key)

    def critic_update(state: SACState, batch: Batch, key: jax.Array) -> tuple[SACState, Metrics]:
        _, critic_loss, _ = losses(batch)
        if make_critic_loss:
            critic_loss = make_critic_loss(batch.reward_scale)
        loss, grads = jax.value_and_grad(critic_loss)(
            state.critic,
            state.policy,
            None,
            state.target_critic,
            jnp.exp(state.log_alpha),
            batch.transitions,
            key,
        )
        rate = config.critic_learning_rate * batch.rate_factor
        critic, critic_optimizer = apply_gradients(optimizer, state.critic, grads, state.critic_optimizer, rate)
        new_state = state.replace(
            critic=critic,
            critic_optimizer=critic_optimizer,
            target_critic=move_towards(state.target_critic, critic, config.tau),
        )
        return new_state, {"critic_loss": loss, "critic_grad_norm": optax.global_norm(grads)}

    def full_update(state: SACState, batch: Batch, key: jax.Array) -> tuple[SACState, Metrics]:
        alpha_key, critic_key, policy_key = jax.random.split(key, 3)
        alpha_loss, _, policy_loss = losses(batch)
        alpha_grad = jax.grad(alpha_loss)(state.log_alpha, state.policy, None, batch.transitions, alpha_key)
        loss, grads = jax.value_and_grad(policy_loss)(
            state.policy, None, state.critic, jnp.exp(state.log_alpha), batch.transitions, policy_key
        )
        new_state, metrics = critic_update(state, batch, critic_key)
        log_alpha, alpha_optimizer = apply_gradients(
            optimizer, state.log_alpha, alpha_grad, state.alpha_optimizer, config.alpha_learning_rate
        )
        rate = config.policy_learning_rate * batch.rate_factor
        policy, policy_optimizer = apply_gradients(optimizer, state.policy, grads, state.policy_optimizer, rate)
        new_state = new_state.replace(
            policy=policy, policy_optimizer=policy_optimizer, log_alpha=log_alpha, alpha_optimizer=alpha_optimizer
        )
        return new_state, metrics | {"policy_loss": loss, "alpha": jnp.exp(log_alpha)}

    return Learner(init, lambda state: state.policy, act, act, critic_update, full_update)
