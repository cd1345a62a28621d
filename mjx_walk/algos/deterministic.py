"""Base of TD3 and DDPG: a deterministic policy, critics whose minimum is the target, and Gaussian exploration."""

import dataclasses
from typing import ClassVar, TypeVar

import flax
import jax
import jax.numpy as jnp
import optax
from brax.training.networks import FeedForwardNetwork
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.algos.off_policy import OffPolicyAlgorithm
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.algos.off_policy_state import Batch, OffPolicyState
from mjx_walk.common import networks
from mjx_walk.common.optimizers import polyak_update
from mjx_walk.utils.setting_fields import AnyBut, setting
from mjx_walk.utils.types import RESTARTS, Losses, Params, PolicyParams

__all__ = ["DeterministicAlgorithm", "DeterministicConfig", "DeterministicState"]


@dataclasses.dataclass
class DeterministicConfig(OffPolicyConfig):
    """Settings that TD3 and DDPG share."""

    min_exploration_noise: float = setting(0.1, at_least=0)
    """Std of the Gaussian noise on the first environment's actions, in `[-1, 1]`."""
    max_exploration_noise: float = setting(0.1, at_least=0, search="0.1,0.2,0.4,1.0")
    """Std for the last environment, evenly spaced in between: some environments explore, some stay near the policy."""
    noise_repeat: int | None = setting(
        1,
        at_least=1,
        only_if={
            "min_exploration_noise": AnyBut(0),
            "max_exploration_noise": AnyBut(0),
            "learning_starts": AnyBut(0),
        },
    )
    """Steps for which a sample of exploration noise, or a random action before learning starts, is kept.

    If unset, those of about 64 ms.
    """


class DeterministicState(flax.struct.PyTreeNode):
    """Networks and optimizers."""

    policy: Params
    critic: Params
    target_policy: Params
    target_critic: Params
    policy_optimizer: optax.OptState = flax.struct.field(metadata=RESTARTS)
    critic_optimizer: optax.OptState = flax.struct.field(metadata=RESTARTS)


_DeterministicConfigT = TypeVar("_DeterministicConfigT", bound=DeterministicConfig)


@dataclasses.dataclass(frozen=True, eq=False)
class DeterministicAlgorithm(OffPolicyAlgorithm[DeterministicState, _DeterministicConfigT]):
    """A deterministic policy, and critics whose minimum is the target.

    Source: Fujimoto et al. 2018, algorithm 1: both targets move when the policy does.
    """

    num_critics: ClassVar[int]

    policy_network: FeedForwardNetwork = dataclasses.field(init=False, repr=False)
    critic_network: FeedForwardNetwork = dataclasses.field(init=False, repr=False)
    exploration_noise: Array = dataclasses.field(init=False, repr=False)
    """`[B, 1]`: standard deviation of each environment's noise."""

    def __post_init__(self) -> None:
        super().__post_init__()
        config = self.config
        policy, critic = networks.make_deterministic_networks(self.task, config, self.num_critics)
        noise = jnp.linspace(config.min_exploration_noise, config.max_exploration_noise, self.num_envs)[:, None]
        self._set(policy_network=policy, critic_network=critic, exploration_noise=noise)

    def with_policy(
        self, state: OffPolicyState[DeterministicState], policy_params: PolicyParams
    ) -> OffPolicyState[DeterministicState]:
        state = super().with_policy(state, policy_params)
        return state.replace(learner=state.learner.replace(target_policy=state.learner.policy))

    @property
    def target_noise(self) -> tuple[float, float]:
        """Standard deviation and bound of the noise that smooths the target policy."""
        return 0.0, 0.0

    def init_learner(self, key: PRNGKeyArray) -> DeterministicState:
        policy_key, critic_key = jax.random.split(key)
        policy, critic = self.policy_network.init(policy_key), self.critic_network.init(critic_key)
        return DeterministicState(
            policy=policy,
            critic=critic,
            target_policy=policy,
            target_critic=critic,
            policy_optimizer=self.optimizer.init(policy),
            critic_optimizer=self.optimizer.init(critic),
        )

    def deterministic_action(
        self, params: Params, obs: Float[Array, "*B observation_size"]
    ) -> Float[Array, "*B action_size"]:
        """The action of the policy."""
        return jnp.tanh(self.policy_network.apply(None, params, obs))

    def explore(
        self, params: Params, obs: Float[Array, "*B observation_size"], key: PRNGKeyArray
    ) -> Float[Array, "*B action_size"]:
        action = self.deterministic_action(params, obs)
        return jnp.clip(action + self.exploration_noise * jax.random.normal(key, action.shape), -1.0, 1.0)

    def act(
        self, params: Params, obs: Float[Array, "*B observation_size"], key: PRNGKeyArray, deterministic: bool
    ) -> Float[Array, "*B action_size"]:
        return self.deterministic_action(params, obs) if deterministic else self.explore(params, obs, key)

    def critic_target(self, learner: DeterministicState, batch: Batch, key: PRNGKeyArray) -> Float[Array, " N"]:
        """Targets of the critics, from the smoothed target policy and the minimum of the target critics."""
        data = batch.transitions
        std, bound = self.target_noise
        action = self.deterministic_action(learner.target_policy, data.next_observation)
        smoothing = std * jax.random.normal(key, action.shape)
        action = jnp.clip(action + jnp.clip(smoothing, -bound, bound), -1.0, 1.0)
        values = self.critic_network.apply(None, learner.target_critic, data.next_observation, action)
        return data.reward * batch.reward_scale + data.discount * values.min(axis=-1)

    def critic_loss(
        self, critic: Params, target: Float[Array, " N"], batch: Batch
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The squared error, summed over critics, and their mean value."""
        data = batch.transitions
        values = self.critic_network.apply(None, critic, data.observation, data.action)
        return jnp.square(values - target[:, None]).mean(axis=0).sum(), values.mean()

    def policy_loss(self, policy: Params, critic: Params, batch: Batch) -> Float[Array, ""]:
        """Minus the first critic's value of the policy's actions."""
        obs = batch.transitions.observation
        action = self.deterministic_action(policy, obs)
        return -self.critic_network.apply(None, critic, obs, action)[:, 0].mean()

    def critic_update(
        self, learner: DeterministicState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[DeterministicState, Losses]:
        target = self.critic_target(learner, batch, key)
        (loss, value), grads = jax.value_and_grad(self.critic_loss, has_aux=True)(learner.critic, target, batch)
        rate = self.config.critic_learning_rate * batch.rate_factor
        critic, critic_optimizer = self.apply_gradients(learner.critic, grads, learner.critic_optimizer, rate)
        metrics = {"critic_loss": loss, "critic_value": value, "critic_grad_norm": optax.tree.norm(grads)}
        return learner.replace(critic=critic, critic_optimizer=critic_optimizer), metrics

    def full_update(
        self, learner: DeterministicState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[DeterministicState, Losses]:
        learner, metrics = self.critic_update(learner, batch, key)
        loss, grads = jax.value_and_grad(self.policy_loss)(learner.policy, learner.critic, batch)
        rate = self.config.policy_learning_rate * batch.rate_factor
        policy, policy_optimizer = self.apply_gradients(learner.policy, grads, learner.policy_optimizer, rate)
        learner = learner.replace(
            policy=policy,
            policy_optimizer=policy_optimizer,
            target_policy=polyak_update(learner.target_policy, policy, self.config.tau),
            target_critic=polyak_update(learner.target_critic, learner.critic, self.config.tau),
        )
        return learner, metrics | {"policy_loss": loss}
