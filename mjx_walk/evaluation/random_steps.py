"""Many random steps on one engine: does a buffer of the physics overflow, does a step break?"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_walk.envs import Task

__all__ = ["NUM_STEPS", "RandomSteps", "take_random_steps"]

NUM_STEPS = 250
"""Steps from each start. Nothing is reset within them, so that bodies that fall lie on the floor and move there."""


class RandomSteps(NamedTuple):
    """Counts over environment steps."""

    num_steps: int
    overflows: int
    """Steps in which a buffer of the physics was too small."""
    nonfinite: int
    """Steps after which a state was not finite."""


def take_random_steps(task: Task, num_envs: int, num_steps: int, seed: int) -> RandomSteps:
    """Take at least `num_steps` steps with uniformly random actions, in batches of `NUM_STEPS` from new resets.

    Args:
        task: the unbatched environment.
        num_envs: environments in a batch.
        num_steps: least number of environment steps.
        seed: of the resets and the actions.
    """
    num_batches = -(-num_steps // (num_envs * NUM_STEPS))

    @jax.jit
    def batch(key: jax.Array) -> jax.Array:
        reset_key, action_key = jax.random.split(key)
        start = jax.vmap(task.reset)(jax.random.split(reset_key, num_envs))

        def one(state, key):
            shape = (num_envs, task.action_size)
            action = jax.random.uniform(key, shape, minval=task.action_low, maxval=task.action_high)
            state = jax.vmap(task.step)(state, action)
            return state, jnp.stack([state.metrics["overflow"].sum(), state.metrics["nonfinite"].sum()])

        return jax.lax.scan(one, start, jax.random.split(action_key, NUM_STEPS))[1].sum(axis=0)

    counts = [jax.device_get(batch(key)) for key in jax.random.split(jax.random.PRNGKey(seed), num_batches)]
    return RandomSteps(num_batches * num_envs * NUM_STEPS, *(int(sum(count)) for count in zip(*counts, strict=True)))
