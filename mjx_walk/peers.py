"""Other people's trainers, run as they are, to compare with."""

import time
from typing import Any

import jax
import jax.numpy as jnp

_UNROLL_LENGTH = 10


def restore_device_put_replicated() -> None:
    """Put back the function that JAX 0.10 removed and Brax 0.14.2 still calls; nothing where it exists."""
    if hasattr(jax, "device_put_replicated"):
        return

    def device_put_replicated(tree: Any, devices: list[jax.Device]) -> Any:
        assert len(devices) == 1, "the stand-in serves one device"
        return jax.tree.map(lambda x: jax.device_put(jnp.asarray(x)[None], devices[0]), tree)

    jax.device_put_replicated = device_put_replicated  # type: ignore[assignment]


def brax_ppo_speed(num_envs: int, batch_size: int, num_minibatches: int, num_updates: int) -> float:
    """Steady environment steps per second of Brax's PPO on Brax's own, reduced `humanoid`.

    Settings: those of Brax's training notebook where they are not arguments; there 2,048, 1,024 and 32.

    Args:
        num_envs: copies, a divisor of `batch_size × num_minibatches`.
        batch_size: pieces of ten steps in a minibatch.
        num_minibatches: minibatches of an update.
        num_updates: updates measured, after as many that compile and warm up.
    """
    from brax import envs
    from brax.training.agents.ppo import train as ppo

    restore_device_put_replicated()
    clock: list[tuple[float, int]] = []
    ppo.train(
        environment=envs.get_environment("humanoid", backend="mjx"),
        num_timesteps=2 * num_updates * batch_size * num_minibatches * _UNROLL_LENGTH,
        num_evals=3,  # so that the clock is read after each half
        episode_length=1000,
        num_envs=num_envs,
        unroll_length=_UNROLL_LENGTH,
        batch_size=batch_size,
        num_minibatches=num_minibatches,
        num_updates_per_batch=8,
        discounting=0.97,
        learning_rate=3e-4,
        entropy_cost=1e-3,
        reward_scaling=0.1,
        normalize_observations=True,
        num_eval_envs=8,
        run_evals=False,
        progress_fn=lambda steps, _: clock.append((time.monotonic(), steps)),
    )
    (start, steps_before), (end, steps_after) = clock[-2:]
    return (steps_after - steps_before) / (end - start)
