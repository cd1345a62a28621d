"""Brax's losses of PPO and SAC, and everything that it takes to feed them."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo.networks import PPONetworks
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac.networks import SACNetworks
from jax import Array
from jaxtyping import Bool, Float

from mjx_walk.utils.types import Losses, Transition

__all__ = [
    "PPOLossConfig",
    "PPOParams",
    "PolicyExtras",
    "SACLosses",
    "compute_gae",
    "make_ppo_loss",
    "make_sac_losses",
    "on_policy_transition",
]

PPOParams = ppo_losses.PPONetworkParams
"""Parameters of policy and value network."""

PolicyExtras = Mapping[str, Array]
"""Raw actions, their log-probabilities and the distribution's parameters, by Brax's names."""


@runtime_checkable
class PPOLossConfig(Protocol):
    """Settings of Brax's PPO loss; `PPOConfig` documents them."""

    discount: float
    gae_lambda: float
    clip_epsilon: float
    normalize_advantages: bool
    value_loss_coef: float


def on_policy_transition(
    obs: Float[Array, "B observation_size"],
    reward: Float[Array, " B"],
    terminated: Bool[Array, " B"],
    truncated: Bool[Array, " B"],
    policy_extras: PolicyExtras,
) -> Transition:
    """A step as Brax's PPO loss reads it; what it does not read is empty.

    The raw action is in `policy_extras`; next observations are added to a complete unroll.
    """
    return Transition(
        observation=obs,
        action=(),
        reward=reward,
        discount=1.0 - jnp.float32(terminated),
        next_observation=(),
        extras={"policy_extras": policy_extras, "state_extras": {"truncation": jnp.float32(truncated)}},
    )


def make_ppo_loss(
    nets: PPONetworks, config: PPOLossConfig, entropy_coef: Float[Array, ""] | float, reward_scale: Float[Array, ""]
) -> Callable[..., tuple[Float[Array, ""], Losses]]:
    """`(params, normalizer, transitions [N, T, …], key) → (loss, metrics)`.

    Args:
        nets: policy and value network.
        config: settings of the loss.
        entropy_coef: coefficient of the entropy bonus.
        reward_scale: factor of the rewards.
    """
    return functools.partial(
        ppo_losses.compute_ppo_loss,
        ppo_network=nets,
        entropy_cost=entropy_coef,
        discounting=config.discount,
        reward_scaling=reward_scale,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip_epsilon,
        normalize_advantage=config.normalize_advantages,
        vf_coefficient=config.value_loss_coef,
    )


compute_gae = ppo_losses.compute_gae


@dataclasses.dataclass(frozen=True)
class SACLosses:
    """Brax's losses of temperature, critics and policy, on transitions whose observations are normalized.

    `temperature(log_alpha, policy, transitions, key)`, `critic(critic, policy, target_critic, alpha, transitions, key)`
    and `policy(policy, critic, alpha, transitions, key)`, each `[] f32`.
    """

    temperature: Callable[..., Array]
    critic: Callable[..., Array]
    policy: Callable[..., Array]


def make_sac_losses(
    nets: SACNetworks, reward_scale: Float[Array, ""], target_entropy: Float[Array, ""] | float, action_size: int
) -> SACLosses:
    """Brax's SAC losses.

    Args:
        nets: policy and critics, which normalize no observations.
        reward_scale: factor of the rewards.
        target_entropy: nats per action dimension.
        action_size: number of action dimensions.
    """
    # Brax uses the action size only for a target entropy of -0.5 nats per dimension, and γ is in the discounts.
    size = -2.0 * target_entropy * action_size
    temperature, critic, policy = sac_losses.make_losses(nets, reward_scale, discounting=1.0, action_size=size)
    return SACLosses(
        temperature=lambda log_alpha, policy_params, *rest: temperature(log_alpha, policy_params, None, *rest),
        critic=lambda critic_params, policy_params, *rest: critic(critic_params, policy_params, None, *rest),
        policy=lambda policy_params, *rest: policy(policy_params, None, *rest),
    )
