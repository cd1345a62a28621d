"""Many copies of one environment: batching, automatic resets that keep the terminal observation, episode sums."""

from typing import Any, NamedTuple

import flax
import jax
import jax.numpy as jnp

from mjx_walk.envs import State, Task
from mjx_walk.envs.inline_evaluation import InlineEvaluation, InlineEvaluator
from mjx_walk.utils.types import Metrics


class EpisodeSums(flax.struct.PyTreeNode):
    """Sums over the current episode of each copy, `[B] f32`."""

    reward: jax.Array
    terms: dict[str, jax.Array]


class VectorState(flax.struct.PyTreeNode):
    """All copies, and the pool of random starts that copies whose episode has ended restart from."""

    env: State
    """`[B, …]`."""
    sums: EpisodeSums
    started_at_reset: jax.Array
    """`[B] bool`: the current episode began at a reset, so its sums count."""
    pool: State
    """`[R, …]` fresh random resets."""
    pool_used: jax.Array
    """`[] i32`: starts handed out since the pool was renewed."""
    live: InlineEvaluation
    """The evaluation that rides along."""


class Outcome(NamedTuple):
    """What a step led to, before any reset: `[B, …]`."""

    obs: jax.Array
    """The true next observation, terminal ones included."""
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class VectorEnv:
    """`num_envs` copies of a task that learn, and the evaluator's, all stepped together."""

    def __init__(self, task: Task, num_envs: int, evaluator: InlineEvaluator, stagger: bool = False):
        """
        Args:
            task: the unbatched environment.
            num_envs: copies, B.
            evaluator: its copies, at most B, join the batch.
            stagger: start the copies at random times of their first episode, so that copies which never fall are
                not cut off all at once. These first, shorter episodes are left out of the episode metrics.
        """
        self.task = task
        self.num_envs = num_envs
        self.evaluator = evaluator
        self.stagger = stagger

    def init(self, key: jax.Array, policy_params: Any) -> VectorState:
        """All copies freshly reset, with a new pool; the first evaluation is of `policy_params`."""
        env_key, pool_key, stagger_key = jax.random.split(key, 3)
        env = self._reset_many(env_key)
        if self.stagger:
            limit = self.task.options.max_episode_steps
            env = env.replace(steps=jax.random.randint(stagger_key, (self.num_envs,), 0, limit, jnp.int32))
        zeros = jnp.zeros(self.num_envs, jnp.float32)
        pool = self._reset_many(pool_key)
        return VectorState(
            env=env,
            sums=EpisodeSums(zeros, dict.fromkeys(self.task.reward_terms, zeros)),
            started_at_reset=env.steps == 0,
            pool=pool,
            pool_used=jnp.zeros((), jnp.int32),
            live=self.evaluator.init(policy_params, pool),
        )

    def renew(
        self, state: VectorState, key: jax.Array, policy_params: Any, update: jax.Array
    ) -> tuple[VectorState, Metrics]:
        """Once an update: draw new random starts, and begin the next evaluation where one has ended.

        A reset observation needs a forward pass, too dear for every copy at every step; hence the pool.

        Args:
            state: all copies.
            key: random key.
            policy_params: the present policy.
            update: `[] i32`, the number of updates behind it.

        Returns:
            The next state, and the scores of `InlineEvaluator.next_round`.
        """
        pool = self._reset_many(key)
        live, scores = self.evaluator.next_round(state.live, policy_params, update, pool)
        return state.replace(pool=pool, pool_used=jnp.zeros((), jnp.int32), live=live), scores

    def _reset_many(self, key: jax.Array) -> State:
        return jax.vmap(self.task.reset)(jax.random.split(key, self.num_envs))

    def step(self, state: VectorState, action: jax.Array) -> tuple[VectorState, Outcome, Metrics]:
        """Step every copy and restart those whose episode has ended.

        Args:
            state: all copies.
            action: `[B, action_size] f32`, in Gymnasium's units.

        Returns:
            The next state, in which no copy has ended; the outcome before the restarts; and sums over the copies,
            `[] f32` each, that may be added up over steps: `episodes`, then over the episodes that ended `return`,
            `length` and each reward term; `nonfinite`, `overflow`, `resets` and `resets_reused`.
        """
        env, live = self._step_all(state, action)
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

        ended = jnp.float32(done & state.started_at_reset)
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
            started_at_reset=state.started_at_reset | done,
            pool_used=pool_used,
            live=live,
        )
        return next_state, Outcome(env.obs, env.reward, env.terminated, env.truncated), stats

    def _step_all(self, state: VectorState, action: jax.Array) -> tuple[State, InlineEvaluation]:
        """One physics call for the copies that learn and those that are evaluated."""
        copies = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), state.env, state.live.env)
        actions = jnp.concatenate([action, self.evaluator.act(state.live)])
        copies = jax.vmap(self.task.step)(copies, actions)
        env = jax.tree.map(lambda x: x[: self.num_envs], copies)
        evaluated = jax.tree.map(lambda x: x[self.num_envs :], copies)
        return env, self.evaluator.record(state.live, evaluated)


def _where(condition: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    return jnp.where(condition.reshape(condition.shape + (1,) * (new.ndim - condition.ndim)), new, old)
