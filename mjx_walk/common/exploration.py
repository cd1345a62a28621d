"""Exploration noise that is correlated in time."""

import dataclasses

import jax
import jax.numpy as jnp


@dataclasses.dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """Noise that wanders and is pulled back to zero: `x ← (1 − theta) x + std · N(0, 1)`.

    Source: Lillicrap et al. 2016, with a time step of one. Its own std in the long run is `std / √(1 − (1 − theta)²)`.
    It runs on across the ends of episodes.
    """

    std: float
    theta: float

    def init(self, num_envs: int, action_size: int) -> jax.Array:
        """No noise, `[B, action_size]`."""
        return jnp.zeros((num_envs, action_size))

    def sequence(self, noise: jax.Array, key: jax.Array, num_steps: int) -> jax.Array:
        """The next T values after `noise` `[B, action_size]`, `[T, B, action_size]`."""

        def wander(noise, kick):
            noise = (1.0 - self.theta) * noise + self.std * kick
            return noise, noise

        return jax.lax.scan(wander, noise, jax.random.normal(key, (num_steps, *noise.shape)))[1]
