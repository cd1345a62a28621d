"""Run a policy: collect training data, or evaluate."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_walk.envs import Task
from mjx_walk.envs.vector_env import Outcome, VectorEnv, VectorState
from mjx_walk.utils.types import Metrics, PolicyFn

Actor = Callable[[jax.Array, Any], tuple[jax.Array, Any]]
"""`(obs [B, …], key or more) → (action [B, action_size] in Gymnasium's units, extras)`."""


class Step(NamedTuple):
    """One step of all copies, `[B, …]`; stacked over time, `[T, B, …]`."""

    obs: jax.Array
    action: jax.Array
    outcome: Outcome
    extras: Any


def unroll(
    env: VectorEnv,
    state: VectorState,
    actor: Actor,
    keys: Any,
    keep: Callable[[Step], Any],
) -> tuple[VectorState, Any, Metrics]:
    """Step all copies T times.

    Args:
        env: the copies.
        state: where they are.
        actor: chooses actions.
        keys: `[T]` random keys, or a tree of `[T, …]`, for the actor.
        keep: what of each step to store; whatever it drops takes no memory.

    Returns:
        The copies' next state; what was kept, `[T, B, …]`; and the sums of `VectorEnv.step` over all steps.
    """

    def one(state, key):
        obs = state.env.obs
        action, extras = actor(obs, key)
        state, outcome, stats = env.step(state, action)
        return state, (keep(Step(obs, action, outcome, extras)), stats)

    state, (kept, stats) = jax.lax.scan(one, state, keys)
    return state, kept, jax.tree.map(lambda x: x.sum(0), stats)


def evaluate(task: Task, num_episodes: int, policy: PolicyFn, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whole episodes, side by side.

    Args:
        task: the unbatched environment.
        num_episodes: B.
        policy: usually deterministic.
        key: starts and, if the policy draws, actions.

    Returns:
        Undiscounted returns `[B] f32` and lengths `[B] i32`.
    """
    reset_key, run_key = jax.random.split(key)
    start = jax.vmap(task.reset)(jax.random.split(reset_key, num_episodes))

    def one(carry, key):
        state, alive, returns, lengths = carry
        state = jax.vmap(task.step)(state, policy(state.obs, key))
        returns += jnp.where(alive, state.reward, 0.0)
        lengths += alive
        return (state, alive & ~state.terminated, returns, lengths), None

    none = jnp.zeros(num_episodes, jnp.float32)
    carry = (start, jnp.ones(num_episodes, bool), none, none.astype(jnp.int32))
    keys = jax.random.split(run_key, task.options.max_episode_steps)
    (_, _, returns, lengths), _ = jax.lax.scan(one, carry, keys)
    return returns, lengths
