"""Discounted returns on `[T, B]` arrays, and their running scale."""

import flax
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int32

from mjx_walk.utils import collectives
from mjx_walk.utils.types import PER_DEVICE

__all__ = [
    "ReturnScale",
    "bootstrap_truncated",
    "init_return_scale",
    "n_step_return",
    "returns_to_go",
    "reward_multiplier",
    "update_return_scale",
]


def bootstrap_truncated(
    reward: Float[Array, "*batch"],
    truncated: Bool[Array, "*batch"],
    next_value: Float[Array, "*batch"],
    discount: float,
    reward_scale: Float[Array, ""] | float,
) -> Float[Array, "*batch"]:
    """Fold the value lost at a time limit into the reward of the step that met it.

    A truncated step can then be handled like a terminated one, because its reward includes the lost value.

    Args:
        reward: unscaled.
        truncated: true only where the episode did not also terminate.
        next_value: value of the true next observation, on the scale of the scaled rewards.
        discount: γ.
        reward_scale: what the learner will multiply rewards by.

    Returns:
        Unscaled rewards: `r + γ V(s') / scale` where truncated, `r` elsewhere.
    """
    return reward + jnp.where(truncated, discount * next_value / reward_scale, 0.0)


def n_step_return(
    reward: Float[Array, "n N"], ended: Bool[Array, "n N"], discount: Float[Array, ""] | float
) -> tuple[Float[Array, " N"], Int32[Array, " N"]]:
    """Discounted rewards up to the end of the episode, or over all n steps.

    Args:
        reward: unscaled.
        ended: whether the episode ended at a step, in whichever way.
        discount: γ.

    Returns:
        `Σ γ^i r_i` over the steps that count, and their number, from 1 to n.
    """
    steps = jnp.arange(reward.shape[0])[:, None]
    still_on = jnp.cumsum(ended, axis=0) - ended == 0
    return (still_on * discount**steps * reward).sum(axis=0), still_on.sum(axis=0, dtype=jnp.int32)


def returns_to_go(
    reward: Float[Array, "T N"], terminated: Bool[Array, "T N"], truncated: Bool[Array, "T N"], discount: float
) -> tuple[Float[Array, "T N"], Float[Array, "T N"]]:
    """Observed discounted rewards from each step to the end of its episode.

    Args:
        reward: unscaled.
        terminated: no reward follows this step.
        truncated: the episode was cut off after this step.
        discount: γ.

    Returns:
        The sums; and the factor at which the future that was not seen would enter: 0 where the episode terminated, else
        γ to the number of steps to the cut or to the last of the T.
    """

    def back(carry, step):
        later, unseen = carry
        reward, terminated, truncated = step
        is_end = terminated | truncated
        later = reward + discount * jnp.where(is_end, 0.0, later)
        unseen = discount * jnp.where(terminated, 0.0, jnp.where(truncated, 1.0, unseen))
        return (later, unseen), (later, unseen)

    none = jnp.zeros(reward.shape[1:], jnp.float32)
    _, sums = jax.lax.scan(back, (none, none + 1.0), (reward, terminated, truncated), reverse=True)
    return sums


class ReturnScale(flax.struct.PyTreeNode):
    """Running variance and bound of the discounted return, by which rewards may be normalized.

    Source: `VecNormalize` of Stable-Baselines3 (`r / std(G)`, with `G ← γ G + r` running through each environment).
    """

    running_return: Array = flax.struct.field(metadata=PER_DEVICE)
    """`[B] f32`."""
    count: Array
    mean: Array
    variance: Array
    largest: Array
    """The largest `|G|` so far."""


def init_return_scale(num_envs: int) -> ReturnScale:
    """Unit scale before the first return."""
    return ReturnScale(jnp.zeros(num_envs), jnp.float32(1e-4), jnp.float32(0.0), jnp.float32(1.0), jnp.float32(0.0))


def update_return_scale(
    scale: ReturnScale,
    reward: Float[Array, "T B"],
    done: Bool[Array, "T B"],
    discount: Float[Array, ""] | float,
    axis_name: str | None = None,
) -> ReturnScale:
    """Add a chronological block of rewards, one on each device, to the running variance."""

    def advance(running, inputs):
        reward, done = inputs
        running = discount * running + reward
        return jnp.where(done, 0.0, running), running

    running, returns = jax.lax.scan(advance, scale.running_return, (reward, done))
    batch_count = collectives.total(jnp.float32(returns.size), axis_name)
    batch_mean = collectives.mean(returns.mean(), axis_name)
    batch_variance = collectives.mean(jnp.square(returns - batch_mean).mean(), axis_name)
    count = scale.count + batch_count
    delta = batch_mean - scale.mean
    mean = scale.mean + delta * batch_count / count
    squares = scale.variance * scale.count + batch_variance * batch_count
    variance = (squares + delta**2 * scale.count * batch_count / count) / count
    largest = jnp.maximum(scale.largest, collectives.largest(jnp.abs(returns).max(), axis_name))
    return ReturnScale(running, count, mean, variance, largest)


def reward_multiplier(scale: ReturnScale, bound: float | None = None) -> Float[Array, ""]:
    """`1 / std(G)`, or less if a bound is given and the largest normalized `|G|` would exceed it.

    Source of the bound: SimbaV2 (Lee et al. 2025).
    """
    multiplier = jax.lax.rsqrt(scale.variance + 1e-8)
    return multiplier if bound is None else jnp.minimum(multiplier, bound / (scale.largest + 1e-8))
