"""Advantage actor-critic (Mnih et al. 2016), synchronous: each step of many environments is learned from once."""

import dataclasses

import jax
import jax.numpy as jnp
from brax.training.acme.running_statistics import RunningStatisticsState
from jax import Array
from jaxtyping import Float

from mjx_walk.algos.on_policy import OnPolicyBatch, OnPolicyState
from mjx_walk.algos.policy_gradient import PolicyGradientAlgorithm, PolicyGradientConfig, Samples, normalize
from mjx_walk.common.brax_losses import PPOParams, compute_gae
from mjx_walk.common.exploration import Exploration, NoExploration, OrnsteinUhlenbeck
from mjx_walk.utils.setting_fields import AnyBut, setting
from mjx_walk.utils.types import Losses

__all__ = ["A2C", "A2CConfig"]


@dataclasses.dataclass
class A2CConfig(PolicyGradientConfig):
    """Settings of A2C. `gae_lambda=0` gives the one-step temporal difference as advantage."""

    name: str = setting("a2c", choices=("a2c",))
    ou_noise_std: float = setting(0.0, at_least=0)
    """Standard deviation of the increments of Ornstein-Uhlenbeck noise, added to actions in [-1, 1]; 0: no noise."""
    ou_noise_theta: float = setting(0.15, above=0, at_most=1, only_if={"ou_noise_std": AnyBut(0)})
    """The fraction of that noise that decays at every step."""


@dataclasses.dataclass(frozen=True, eq=False)
class A2C(PolicyGradientAlgorithm[A2CConfig]):
    """The policy gradient on generalised advantages.

    Source: Mnih et al. 2016, algorithm S3.
    """

    def make_exploration(self) -> Exploration:
        if not self.config.ou_noise_std:
            return NoExploration()
        return OrnsteinUhlenbeck(self.config.ou_noise_std, self.config.ou_noise_theta)

    def value_loss(
        self, params: PPOParams, normalizer: RunningStatisticsState, samples: Samples
    ) -> tuple[Float[Array, ""], Losses]:
        values = self.nets.value_network.apply(normalizer, params.value, samples.observation)
        loss = jnp.square(samples.target - values).mean()
        return self.config.value_loss_coef * loss, {"value_loss": loss}

    def samples(self, state: OnPolicyState, batch: OnPolicyBatch) -> Samples:
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch.transitions)
        value_network = self.nets.value_network
        values = value_network.apply(state.normalizer, state.params.value, data.observation)
        targets, _ = compute_gae(
            truncation=data.extras["state_extras"]["truncation"],
            termination=1.0 - data.discount,
            rewards=data.reward * batch.reward_scale,
            values=values,
            bootstrap_value=value_network.apply(state.normalizer, state.params.value, data.next_observation[0]),
            lambda_=self.config.gae_lambda,
            discount=self.config.discount,
        )
        # Brax's advantages look one step further ahead than λ says.
        advantages, weight = targets - values, jnp.ones_like(values)
        if self.config.normalize_advantages:
            advantages = normalize(advantages, weight)
        acted = data.extras["policy_extras"]
        return Samples(data.observation, acted["raw_action"], acted["log_prob"], advantages, weight, targets)
