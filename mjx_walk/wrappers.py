"""Many copies of one environment: batching, automatic resets that keep the terminal observation, episode sums."""

from typing import NamedTuple

import flax
import jax
import jax.numpy as jnp

from mjx_walk.envs import State, Task


@flax.struct.dataclass
class EpisodeSums:
    """Sums over the current episode of each copy, `[B] f32`."""

    reward: jax.Array
    terms: dict[str, jax.Array]


@flax.struct.dataclass
class VectorState:
    """All copies, and the pool of random starts that copies whose episode has ended restart from."""

    env: State
    """`[B, …]`."""
    sums: EpisodeSums
    is_whole: jax.Array
    """`[B] bool`: the current episode began at a reset, so its sums count."""
    pool: State
    """`[R, …]` fresh random resets."""
    pool_used: jax.Array
    """`[] i32`: starts handed out since the pool was renewed."""


class Outcome(NamedTuple):
    """What a step led to, before any reset: `[B, …]`."""

    obs: jax.Array
    """The true next observation, terminal ones included."""
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class VectorEnv:
    """`num_envs` copies of a task, stepped together."""

    def __init__(self, task: Task, num_envs: int, stagger: bool = False):
        """
        Args:
            task: the unbatched environment.
            num_envs: copies, B.
            stagger: start the copies at random times of their first episode, so that copies which never fall are
                not cut off all at once. These first, shorter episodes are left out of the episode metrics.
        """
        self.task = task
        self.num_envs = num_envs
        self.stagger = stagger

    def init(self, key: jax.Array) -> VectorState:
        """All copies freshly reset, with a new pool."""
        env_key, pool_key, stagger_key = jax.random.split(key, 3)
        env = self._reset_many(env_key)
        if self.stagger:
            limit = self.task.options.max_episode_steps
            env = env.replace(steps=jax.random.randint(stagger_key, (self.num_envs,), 0, limit, jnp.int32))
        zeros = jnp.zeros(self.num_envs, jnp.float32)
        return VectorState(
            env=env,
            sums=EpisodeSums(zeros, {name: zeros for name in self.task.reward_terms}),
            is_whole=env.steps == 0,
            pool=self._reset_many(pool_key),
            pool_used=jnp.zeros((), jnp.int32),
        )

    def renew_pool(self, state: VectorState, key: jax.Array) -> VectorState:
        """Draw new random starts. A reset observation needs a forward pass, too dear for every copy at every step."""
        return state.replace(pool=self._reset_many(key), pool_used=jnp.zeros((), jnp.int32))

    def _reset_many(self, key: jax.Array) -> State:
        return jax.vmap(self.task.reset)(jax.random.split(key, self.num_envs))

    def step(self, state: VectorState, action: jax.Array) -> tuple[VectorState, Outcome, dict[str, jax.Array]]:
        """Step every copy and restart those whose episode has ended.

        Args:
            state: all copies.
            action: `[B, action_size] f32`, in Gymnasium's units.

        Returns:
            The next state, in which no copy has ended; the outcome before the restarts; and sums over the copies,
            `[] f32` each, that may be added up over steps: `episodes`, then over the episodes that ended `return`,
            `length` and each reward term; `nonfinite`, `overflow`, `resets` and `resets_reused`.
        """
        env = jax.vmap(self.task.step)(state.env, action)
        done = env.terminated | env.truncated
        sums = EpisodeSums(
            state.sums.reward + env.reward,
            {name: state.sums.terms[name] + env.metrics[name] for name in self.task.reward_terms},
        )

        num_done = done.sum(dtype=jnp.int32)
        start = (state.pool_used + jnp.cumsum(done) - 1) % self.num_envs
        starts = jax.tree.map(lambda x: x[start], state.pool)
        restarted = jax.tree.map(lambda new, old: _where(done, new, old), starts, env)
        pool_used = state.pool_used + num_done
        reused = jnp.maximum(pool_used - self.num_envs, 0) - jnp.maximum(state.pool_used - self.num_envs, 0)

        ended = jnp.float32(done & state.is_whole)
        stats = {
            "episodes": ended.sum(),
            "return": (ended * sums.reward).sum(),
            "length": (ended * env.steps).sum(),
            **{name: (ended * value).sum() for name, value in sums.terms.items()},
            "nonfinite": env.metrics["nonfinite"].sum(),
            "overflow": env.metrics["overflow"].sum(),
            "resets": jnp.float32(num_done),
            "resets_reused": jnp.float32(reused),
        }
        next_state = state.replace(
            env=restarted,
            sums=jax.tree.map(lambda x: jnp.where(done, 0.0, x), sums),
            is_whole=state.is_whole | done,
            pool_used=pool_used,
        )
        return next_state, Outcome(env.obs, env.reward, env.terminated, env.truncated), stats


def _where(condition: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    return jnp.where(condition.reshape(condition.shape + (1,) * (new.ndim - condition.ndim)), new, old)
