"""REINFORCE (Williams 1992) for many environments: the policy gradient on observed returns, without a value network."""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from mjx_walk.algos.on_policy import OnPolicyBatch, OnPolicyState
from mjx_walk.algos.policy_gradient import PolicyGradientAlgorithm, PolicyGradientConfig, Samples, normalize
from mjx_walk.common import returns
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import Metrics, as_means

__all__ = ["REINFORCE", "REINFORCEConfig", "linear_fit", "standardize"]


@dataclasses.dataclass
class REINFORCEConfig(PolicyGradientConfig):
    """Settings of REINFORCE. It has no value network, and normalizes the returns of each batch."""

    name: str = setting("reinforce", choices=("reinforce",))
    unroll_length: int = setting(256, at_least=1)
    discount: float = setting(0.97, at_least=0, at_most=1, search="0.95,0.97,0.98,0.99")
    max_tail_discount: float = setting(0.05, above=0, at_most=1)
    """A step is used only if the discount on its unobserved tail is at most this."""
    baseline: str = setting("linear", choices=("mean", "linear"))
    """Subtracted from returns: the mean of the batch, or a linear fit of its returns to its observations."""
    gae_lambda: float = setting(0.95, at_least=0, at_most=1, only_if={})
    value_loss_coef: float = setting(0.5, above=0, only_if={})
    value_hidden_layer_sizes: tuple[int, ...] = setting((256, 256, 256, 256), at_least=1, only_if={})
    max_value_grad_norm: float | None = setting(None, above=0, only_if={})
    normalize_advantages: bool = setting(True, only_if={})
    reward_scale: float = setting(0.1, above=0, only_if={})
    normalize_rewards: bool = setting(False, only_if={})


@dataclasses.dataclass(frozen=True, eq=False)
class REINFORCE(PolicyGradientAlgorithm[REINFORCEConfig]):
    """The policy gradient on discounted returns.

    Deviation: environments do not wait for each other's episodes to end. A batch is one unroll of `unroll_length`
    steps, and only its first steps are used: those whose return is known but for a tail that is discounted away
    (`max_tail_discount`). Whether an episode ends within the unroll makes no difference, or falls would be learned from
    more often than what prevents them.

    Raises:
        UserError: the unrolls are too short to learn from; or see `PolicyGradientAlgorithm`.
    """

    has_value: ClassVar[bool] = False

    num_learned: int = dataclasses.field(init=False)
    """Steps of an unroll that are learned from."""

    def __post_init__(self) -> None:
        config = self.config
        tail_discounts = [config.discount ** (config.unroll_length - step) for step in range(config.unroll_length)]
        self._set(num_learned=sum(tail <= config.max_tail_discount for tail in tail_discounts))
        if self.num_learned == 0:
            raise UserError(
                f"algo.unroll_length={config.unroll_length}: the tail after an unroll has a discount of "
                f"{tail_discounts[0]:.2f} at its first step, above algo.max_tail_discount={config.max_tail_discount}; "
                "lengthen it, or lower algo.discount"
            )
        super().__post_init__()

    @property
    def num_learned_steps(self) -> int:
        return self.num_envs * self.config.num_unrolls * self.num_learned

    def samples(self, state: OnPolicyState, batch: OnPolicyBatch) -> Samples:
        data = batch.transitions
        return_to_go, tail_discount = returns.returns_to_go(
            data.reward.T,
            data.discount.T == 0.0,
            data.extras["state_extras"]["truncation"].T > 0.0,
            self.config.discount,
        )
        used = slice(0, self.num_learned)
        # Of these steps, only those before a time limit can have too large a tail.
        weight = jnp.float32(self.config.max_tail_discount >= tail_discount.T[:, used])
        advantage, obs = return_to_go.T[:, used], data.observation[:, used]
        advantage = normalize(advantage, weight)
        if self.config.baseline == "linear":
            advantage = normalize(advantage - linear_fit(obs, advantage, weight), weight)
        acted = jax.tree.map(lambda x: x[:, used], data.extras["policy_extras"])
        return Samples(obs, acted["raw_action"], acted["log_prob"], advantage, weight, target=())

    def update(self, state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        samples = self.samples(state, batch)
        new_state, metrics = self.learn_once(state, batch, samples)
        learned_from = samples.weight.mean() * self.num_learned / self.config.unroll_length
        return new_state, metrics | as_means({"learned_from": learned_from})


_LARGEST = 5.0
"""Bound of features in the fit, in standard deviations, so that no few of them dominate it."""
_RIDGE = 1e-2
"""Small compared with the features' variance of 1, and large enough for duplicate features in float32."""


def linear_fit(
    obs: Float[Array, "N T observation_size"], target: Float[Array, "N T"], weight: Float[Array, "N T"]
) -> Float[Array, "N T"]:
    """Predictions of a least-squares fit of the target to observations and their squares.

    Source: the baseline of REINFORCE in Duan et al. 2016, "Benchmarking deep reinforcement learning for continuous
    control". Deviations: no powers of time, since nothing in these tasks depends on it; fitted to the batch itself.

    Args:
        obs: unnormalized.
        target: of mean 0.
        weight: 0 where a target does not count.
    """
    linear = standardize(obs)
    features = jnp.concatenate([linear, standardize(jnp.square(linear))], axis=-1)
    product = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    ridge = _RIDGE * jnp.maximum(weight.sum(), 1.0) * jnp.eye(features.shape[-1])
    gram = product("nt,ntf,ntg->fg", weight, features, features) + ridge
    moment = product("nt,ntf,nt->f", weight, features, target)
    return product("ntf,f->nt", features, jax.scipy.linalg.solve(gram, moment, assume_a="pos"))


def standardize(features: Float[Array, "N T features"]) -> Float[Array, "N T features"]:
    """Features with mean 0 and std 1 over all but the last axis, clipped; constant features become 0."""
    mean, std = features.mean(axis=(0, 1)), features.std(axis=(0, 1))
    return jnp.clip((features - mean) / (std + 1e-4), -_LARGEST, _LARGEST)
