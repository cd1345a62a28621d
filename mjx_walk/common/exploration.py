"""Exploration noise that an algorithm adds to the actions of its policy."""

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp


class Exploration(Protocol):
    """Noise for unrolls of T steps, added to actions in `[-1, 1]`."""

    def init(self, num_envs: int, action_size: int) -> Any:
        """The state of the noise before the first step."""
        ...

    def unroll(self, state: Any, key: jax.Array, num_steps: int) -> tuple[Any, jax.Array, jax.Array]:
        """The noise of T steps.

        Returns:
            The next state of the noise; the noise, `[T, B, action_size]` or `[T]`; and the key for the actions.
        """
        ...


class NoExploration:
    """No noise besides the policy's own distribution."""

    def init(self, num_envs: int, action_size: int) -> tuple[()]:
        return ()

    def unroll(self, state: tuple[()], key: jax.Array, num_steps: int) -> tuple[tuple[()], jax.Array, jax.Array]:
        return state, jnp.zeros(num_steps), key


@dataclasses.dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """Noise that is correlated in time and decays to zero: `x ← (1 − theta) x + std · N(0, 1)`.

    It continues across the ends of episodes. Its stationary standard deviation is `std / √(1 − (1 − theta)²)`.

    Source: Lillicrap et al. 2016, with a time step of one.
    """

    std: float
    theta: float

    def init(self, num_envs: int, action_size: int) -> jax.Array:
        """No noise, `[B, action_size]`."""
        return jnp.zeros((num_envs, action_size))

    def unroll(self, state: jax.Array, key: jax.Array, num_steps: int) -> tuple[jax.Array, jax.Array, jax.Array]:
        key, noise_key = jax.random.split(key)
        noise = self.sequence(state, noise_key, num_steps)
        return noise[-1], noise, key

    def sequence(self, noise: jax.Array, key: jax.Array, num_steps: int) -> jax.Array:
        """The next T values after `noise` `[B, action_size]`, `[T, B, action_size]`."""

        def advance(noise, gaussian):
            noise = (1.0 - self.theta) * noise + self.std * gaussian
            return noise, noise

        return jax.lax.scan(advance, noise, jax.random.normal(key, (num_steps, *noise.shape)))[1]
