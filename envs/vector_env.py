"""Many environments in one batch: automatic resets that keep the terminal observation, and sums over episodes."""

from typing import NamedTuple

import flax
import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.envs.base_task import BaseTask
from mjx_walk.envs.state import MAX_ABS_VALUE, State
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Metric, Metrics, Reduction

__all__ = ["EpisodeSums", "Outcome", "VectorEnv", "VectorState", "check_resets"]


class EpisodeSums(flax.struct.PyTreeNode):
    """Sums over the current episode of each environment, `[B] f32`."""

    reward: jax.Array
    terms: dict[str, jax.Array]


class VectorState(flax.struct.PyTreeNode):
    """The environments that train, and the pool of random starts for those whose episode ends."""

    env: State
    """`[B, …]`."""
    sums: EpisodeSums
    started_at_reset: jax.Array
    """`[B] bool`: the current episode started at a reset, so its sums count."""
    pool: State
    """`[B, …]` fresh random resets, whose step counts are random if episodes that follow a fall may start at one."""
    pool_used: jax.Array
    """`[] i32`: starts taken since the pool was renewed."""


class Outcome(NamedTuple):
    """Result of a step, before any reset: `[B, …]`."""

    obs: jax.Array
    """The true next observation, terminal ones included."""
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class VectorEnv:
    """`num_envs` environments that train. Others, which it does not reset, join their physics calls."""

    def __init__(
        self,
        task: BaseTask,
        num_envs: int,
        init_at_random_episode_step: bool = False,
        random_step_after_falls: bool = False,
    ):
        """
        Args:
            task: the unbatched environment.
            num_envs: number of environments that train, B.
            init_at_random_episode_step: start the first episodes at random step counts, so that time limits do not
                end all episodes at once. The episode metrics leave out these first, shorter episodes.
            random_step_after_falls: start every second episode that follows a fall at a random step count, too.
                Environments that fall and learn at the same time would otherwise reach the time limit together.
        """
        self.task = task
        self.num_envs = num_envs
        self.init_at_random_episode_step = init_at_random_episode_step
        self.random_step_after_falls = random_step_after_falls

    def init(self, key: jax.Array) -> VectorState:
        """All environments freshly reset, with a new pool."""
        env_key, pool_key, episode_step_key = jax.random.split(key, 3)
        env = self._reset_many(env_key)
        if self.init_at_random_episode_step:
            env = env.replace(steps=self._random_steps(episode_step_key))
        zeros = jnp.zeros(self.num_envs, jnp.float32)
        return VectorState(
            env=env,
            sums=EpisodeSums(zeros, dict.fromkeys(self.task.reward_terms, zeros)),
            started_at_reset=env.steps == 0,
            pool=self._draw_pool(pool_key),
            pool_used=jnp.zeros((), jnp.int32),
        )

    def renew_pool(self, state: VectorState, key: jax.Array) -> VectorState:
        """Draw new random starts, once an iteration.

        The observation of a reset needs a forward pass, which is too expensive for every environment at every step.
        """
        return state.replace(pool=self._draw_pool(key), pool_used=jnp.zeros((), jnp.int32))

    def _draw_pool(self, key: jax.Array) -> State:
        pool = self._reset_many(key)
        if not self.random_step_after_falls:
            return pool
        return pool.replace(steps=self._random_steps(jax.random.fold_in(key, 1)))

    def _random_steps(self, key: jax.Array) -> jax.Array:
        limit = self.task.options.max_episode_steps
        return jax.random.randint(key, (self.num_envs,), 0, limit, jnp.int32)

    def _reset_many(self, key: jax.Array) -> State:
        return jax.vmap(self.task.reset)(jax.random.split(key, self.num_envs))

    def step(
        self, state: VectorState, action: jax.Array, others: State, others_action: jax.Array
    ) -> tuple[VectorState, State, Outcome, Metrics]:
        """Step every environment, and reset those that train and whose episode ends.

        Args:
            state: the environments that train.
            action: `[B, action_size] f32`, in Gymnasium's units.
            others: `[E, …]`: environments that are stepped in the same physics call.
            others_action: `[E, action_size] f32`, in Gymnasium's units.

        Returns:
            The next state, in which no episode has ended; the other environments; the outcome before the resets; and
            metrics that may be summed over steps: `episodes`, then over the episodes that ended `return`, `length` and
            each reward term; `nonfinite`, `overflow`, `resets` and `resets_reused`.
        """
        env, others = self._step_all(state.env, action, others, others_action)
        done = env.terminated | env.truncated
        sums = EpisodeSums(
            state.sums.reward + env.reward,
            {name: state.sums.terms[name] + env.metrics[name] for name in self.task.reward_terms},
        )
        num_done = done.sum(dtype=jnp.int32)
        start = (state.pool_used + jnp.cumsum(done) - 1) % self.num_envs
        starts = jax.tree.map(lambda x: x[start], state.pool)
        is_random = env.terminated & state.started_at_reset
        starts = starts.replace(steps=jnp.where(is_random, starts.steps, 0))
        pool_used = state.pool_used + num_done
        reused = jnp.maximum(pool_used - self.num_envs, 0) - jnp.maximum(state.pool_used - self.num_envs, 0)
        ended = jnp.float32(done & state.started_at_reset)
        episode_sums = {
            "return": (ended * sums.reward).sum(),
            "length": (ended * env.steps).sum(),
            **{name: (ended * value).sum() for name, value in sums.terms.items()},
        }
        counts = {
            "episodes": ended.sum(),
            "nonfinite": env.metrics["nonfinite"].sum(),
            "overflow": env.metrics["overflow"].sum(),
            "resets": jnp.float32(num_done),
            "resets_reused": jnp.float32(reused),
        }
        next_state = state.replace(
            env=jax.tree.map(lambda new, old: _where(done, new, old), starts, env),
            sums=jax.tree.map(lambda x: jnp.where(done, 0.0, x), sums),
            started_at_reset=jnp.where(done, starts.steps == 0, state.started_at_reset),
            pool_used=pool_used,
        )
        metrics = {name: Metric(value, Reduction.SUM) for name, value in counts.items()}
        metrics |= {name: Metric(value, Reduction.PER_EPISODE) for name, value in episode_sums.items()}
        return next_state, others, Outcome(env.obs, env.reward, env.terminated, env.truncated), metrics

    def _step_all(self, env: State, action: jax.Array, others: State, others_action: jax.Array) -> tuple[State, State]:
        """One physics call for the environments that train and the others."""
        envs = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), env, others)
        envs = jax.vmap(self.task.step)(envs, jnp.concatenate([action, others_action]))
        trained = jax.tree.map(lambda x: x[: self.num_envs], envs)
        return trained, jax.tree.map(lambda x: x[self.num_envs :], envs)


def check_resets(state: VectorState) -> None:
    """Check the first states and the pool of random starts.

    Args:
        state: of a new run, with any leading axes.

    Raises:
        UserError: an observation is not finite, or a position or velocity exceeds `MAX_ABS_VALUE`.
    """
    num_resets, num_bad = 0, 0
    for env in (state.env, state.pool):
        qpos, qvel, obs = map(np.asarray, (env.physics.qpos, env.physics.qvel, env.obs))
        is_valid = (np.abs(qpos) < MAX_ABS_VALUE).all(-1) & (np.abs(qvel) < MAX_ABS_VALUE).all(-1)
        is_valid &= np.isfinite(obs).all(-1)
        num_resets, num_bad = num_resets + is_valid.size, num_bad + (~is_valid).sum()
    if num_bad:
        raise UserError(
            f"{num_bad:,} of {num_resets:,} resets are not finite, or exceed {MAX_ABS_VALUE:.0e}; lower "
            "env.reset_noise_scale, or check the model"
        )


def _where(condition: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    return jnp.where(condition.reshape(condition.shape + (1,) * (new.ndim - condition.ndim)), new, old)
