"""Soft actor-critic (Haarnoja et al. 2018) on Brax's networks and losses."""

import dataclasses

import flax
import jax
import jax.numpy as jnp
import optax
from brax.training.agents.sac.networks import SACNetworks
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.algos.off_policy import OffPolicyAlgorithm
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.algos.off_policy_state import Batch
from mjx_walk.common import networks
from mjx_walk.common.brax_losses import SACLosses, make_sac_losses
from mjx_walk.common.optimizers import polyak_update
from mjx_walk.utils.setting_fields import AnyBut, setting
from mjx_walk.utils.types import RESTARTS, Losses, Params

__all__ = ["SAC", "SACConfig", "SACState"]


@dataclasses.dataclass
class SACConfig(OffPolicyConfig):
    """Settings of SAC."""

    name: str = setting("sac", choices=("sac",))
    init_alpha: float = setting(1.0, above=0)
    """Initial temperature."""
    alpha_learning_rate: float = setting(3e-4, above=0)
    """Step size of Adam for the temperature. It stays constant."""
    target_entropy: float = setting(-0.5, below=0.69, search="interval(-1,0.5)")
    """Entropy at which the temperature keeps the policy, in nats per action dimension; Brax uses -0.5. Actions lie in
    `[-1, 1]`, so no policy has more than ln 2, and under a higher target the temperature would grow without bound."""
    final_target_entropy: float | None = setting(None, below=0.69)
    """Target entropy after `schedule_steps`, approached linearly."""
    schedule_steps: int = setting(
        100_000_000,
        at_least=1,
        only_if={
            "learning_rate_schedule": AnyBut("constant"),
            "final_discount": AnyBut(None),
            "final_target_entropy": AnyBut(None),
        },
    )


class SACState(flax.struct.PyTreeNode):
    """Networks and optimizers."""

    policy: Params
    critic: Params
    target_critic: Params
    log_alpha: Array
    policy_optimizer: optax.OptState = flax.struct.field(metadata=RESTARTS)
    critic_optimizer: optax.OptState = flax.struct.field(metadata=RESTARTS)
    alpha_optimizer: optax.OptState = flax.struct.field(metadata=RESTARTS)


@dataclasses.dataclass(frozen=True, eq=False)
class SAC(OffPolicyAlgorithm[SACState, SACConfig]):
    """Soft actor-critic.

    Source: `sgd_step` of Brax's SAC: temperature, critic and policy take their gradients at the same parameters.
    """

    config: SACConfig
    nets: SACNetworks = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(nets=self.make_networks())

    def make_networks(self) -> SACNetworks:
        """Policy and critics."""
        return networks.make_sac_networks(self.task, self.config)

    def init_learner(self, key: PRNGKeyArray) -> SACState:
        policy_key, critic_key = jax.random.split(key)
        policy, critic = self.nets.policy_network.init(policy_key), self.nets.q_network.init(critic_key)
        log_alpha = jnp.log(jnp.float32(self.config.init_alpha))
        return SACState(
            policy=policy,
            critic=critic,
            target_critic=critic,
            log_alpha=log_alpha,
            policy_optimizer=self.optimizer.init(policy),
            critic_optimizer=self.optimizer.init(critic),
            alpha_optimizer=self.optimizer.init(log_alpha),
        )

    def act(
        self, params: Params, obs: Float[Array, "*B observation_size"], key: PRNGKeyArray, deterministic: bool
    ) -> Float[Array, "*B action_size"]:
        logits = self.nets.policy_network.apply(None, params, obs)
        distribution = self.nets.parametric_action_distribution
        return distribution.mode(logits) if deterministic else distribution.sample(logits, key)

    def explore(
        self, params: Params, obs: Float[Array, "*B observation_size"], key: PRNGKeyArray
    ) -> Float[Array, "*B action_size"]:
        return self.act(params, obs, key, deterministic=False)

    def losses(self, batch: Batch) -> SACLosses:
        """Brax's losses, with the scheduled target entropy."""
        first, last = self.config.target_entropy, self.config.final_target_entropy
        target_entropy = jnp.float32(first) if last is None else last + (first - last) * batch.remaining
        return make_sac_losses(self.nets, batch.reward_scale, target_entropy, self.task.action_size)

    def critic_loss(
        self, critic: Params, learner: SACState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], Losses]:
        """The loss of the critics, and metrics."""
        alpha, losses = jnp.exp(learner.log_alpha), self.losses(batch)
        return losses.critic(critic, learner.policy, learner.target_critic, alpha, batch.transitions, key), {}

    def critic_update(self, learner: SACState, batch: Batch, key: PRNGKeyArray) -> tuple[SACState, Losses]:
        loss_and_grads = jax.value_and_grad(self.critic_loss, has_aux=True)
        (loss, metrics), grads = loss_and_grads(learner.critic, learner, batch, key)
        rate = self.config.critic_learning_rate * batch.rate_factor
        critic, critic_optimizer = self.apply_gradients(learner.critic, grads, learner.critic_optimizer, rate)
        new_learner = learner.replace(
            critic=critic,
            critic_optimizer=critic_optimizer,
            target_critic=polyak_update(learner.target_critic, critic, self.config.tau),
        )
        return new_learner, metrics | {"critic_loss": loss, "critic_grad_norm": optax.tree.norm(grads)}

    def full_update(self, learner: SACState, batch: Batch, key: PRNGKeyArray) -> tuple[SACState, Losses]:
        config, losses = self.config, self.losses(batch)
        alpha_key, critic_key, policy_key = jax.random.split(key, 3)
        alpha_grad = jax.grad(losses.temperature)(learner.log_alpha, learner.policy, batch.transitions, alpha_key)
        loss, grads = jax.value_and_grad(losses.policy)(
            learner.policy, learner.critic, jnp.exp(learner.log_alpha), batch.transitions, policy_key
        )
        new_learner, metrics = self.critic_update(learner, batch, critic_key)
        log_alpha, alpha_optimizer = self.apply_gradients(
            learner.log_alpha, alpha_grad, learner.alpha_optimizer, config.alpha_learning_rate
        )
        rate = config.policy_learning_rate * batch.rate_factor
        policy, policy_optimizer = self.apply_gradients(learner.policy, grads, learner.policy_optimizer, rate)
        new_learner = new_learner.replace(
            policy=policy, policy_optimizer=policy_optimizer, log_alpha=log_alpha, alpha_optimizer=alpha_optimizer
        )
        return new_learner, metrics | {"policy_loss": loss, "alpha": jnp.exp(log_alpha)}
