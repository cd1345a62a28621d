"""Exploration noise that an algorithm adds to the actions of its policy."""

import dataclasses
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PRNGKeyArray

__all__ = ["Exploration", "NoExploration", "OrnsteinUhlenbeck"]

_NoiseT = TypeVar("_NoiseT")


class Exploration(Protocol[_NoiseT]):
    """Noise for unrolls of T steps, added to actions in `[-1, 1]`."""

    def init(self, num_envs: int, action_size: int) -> _NoiseT:
        """The state of the noise before the first step."""
        ...

    def unroll(
        self, state: _NoiseT, key: PRNGKeyArray, num_steps: int
    ) -> tuple[_NoiseT, Float[Array, "T B action_size"] | Float[Array, " T"], PRNGKeyArray]:
        """The noise of T steps.

        Returns:
            The next state of the noise; the noise; and the key for the actions.
        """
        ...


class NoExploration:
    """No noise besides the policy's own distribution."""

    def init(self, num_envs: int, action_size: int) -> tuple[()]:
        return ()

    def unroll(
        self, state: tuple[()], key: PRNGKeyArray, num_steps: int
    ) -> tuple[tuple[()], Float[Array, " {num_steps}"], PRNGKeyArray]:
        return state, jnp.zeros(num_steps), key


@dataclasses.dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """Noise that is correlated in time and decays to zero: `x ← (1 − theta) x + std · N(0, 1)`.

    It continues across the ends of episodes. Its stationary standard deviation is `std / √(1 − (1 − theta)²)`.

    Source: Lillicrap et al. 2016, with a time step of one.
    """

    std: float
    theta: float

    def init(self, num_envs: int, action_size: int) -> Float[Array, "{num_envs} {action_size}"]:
        """No noise."""
        return jnp.zeros((num_envs, action_size))

    def unroll(
        self, state: Float[Array, "B action_size"], key: PRNGKeyArray, num_steps: int
    ) -> tuple[Float[Array, "B action_size"], Float[Array, "{num_steps} B action_size"], PRNGKeyArray]:
        key, noise_key = jax.random.split(key)
        noise = self.sequence(state, noise_key, num_steps)
        return noise[-1], noise, key

    def sequence(
        self, noise: Float[Array, "B action_size"], key: PRNGKeyArray, num_steps: int
    ) -> Float[Array, "{num_steps} B action_size"]:
        """The values of the next steps, after `noise`."""

        def advance(noise, gaussian):
            noise = (1.0 - self.theta) * noise + self.std * gaussian
            return noise, noise

        return jax.lax.scan(advance, noise, jax.random.normal(key, (num_steps, *noise.shape)))[1]
