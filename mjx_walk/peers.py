"""Other people's trainers, run as they are, to compare with."""

import time
from typing import Any

import jax
import jax.numpy as jnp


def restore_device_put_replicated() -> None:
    """Put back the function that JAX 0.10 removed and Brax 0.14.2 still calls; nothing where it exists."""
    if hasattr(jax, "device_put_replicated"):
        return

    def device_put_replicated(tree: Any, devices: list[jax.Device]) -> Any:
        assert len(devices) == 1, "the stand-in serves one device"
        return jax.tree.map(lambda x: jax.device_put(jnp.asarray(x)[None], devices[0]), tree)

    jax.device_put_replicated = device_put_replicated  # type: ignore[assignment]


def brax_ppo_speed(num_envs: int, num_timesteps: int) -> float:
    """Steady environment steps per second of Brax's PPO on Brax's own, reduced `humanoid`.

    Settings: those of Brax's training notebook, with `num_envs` copies.

    Args:
        num_envs: copies, a divisor or multiple of 32 × 1,024.
        num_timesteps: in all; the first of its two halves is not counted, for it compiles.
    """
    from brax import envs
    from brax.training.agents.ppo import train as ppo

    restore_device_put_replicated()
    clock: list[tuple[float, int]] = []
    ppo.train(
        environment=envs.get_environment("humanoid", backend="mjx"),
        num_timesteps=num_timesteps,
        num_evals=3,
        episode_length=1000,
        num_envs=num_envs,
        unroll_length=10,
        batch_size=1024,
        num_minibatches=32,
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
