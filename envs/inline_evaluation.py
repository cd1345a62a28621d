"""Deterministic evaluation that rides along with training: a few more copies in the batch, running a frozen policy.

Run on its own, one evaluation of a thousand steps in turn costs a GPU as much as a third of a million training steps,
because a step of few copies takes nearly as long as one of many. In the training batch its copies cost their share.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import flax
import jax
import jax.numpy as jnp

from mjx_walk.envs import State, Task
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Metrics, PolicyFn


@dataclasses.dataclass
class EvaluationConfig:
    """Deterministic evaluation."""

    num_envs: int = setting(128, at_least=1)
    """Copies that run whole episodes without noise beside those that learn; at most one for each of these."""
    every_steps: int = setting(0, at_least=0)
    """Environment steps of training from the start of one round to the next, at least."""
    gymnasium_episodes: int = setting(100, at_least=0)
    """Episodes in the real Gymnasium after training; 0 leaves it out."""
    films: bool = False
    """Film an episode in the real Gymnasium at the end of each round, into `films/` and for TensorBoard."""


class InlineEvaluation(flax.struct.PyTreeNode):
    """A round of episodes under a snapshot of the policy, and the best snapshot so far."""

    policy_params: Any
    snapshot_iteration: jax.Array
    """`[] i32`: the number of updates behind the snapshot."""
    env: State
    """`[E, …]`."""
    alive: jax.Array
    """`[E] bool`: the episode of this round is not over."""
    returns: jax.Array
    lengths: jax.Array
    best_policy_params: Any
    best_iteration: jax.Array
    best_return: jax.Array
    """`[] f32`, -inf before the first round is over."""


class InlineEvaluator:
    """Rounds of one episode for each copy; a new round begins when the slowest copy is done, and not too early."""

    def __init__(
        self,
        task: Task,
        num_train_envs: int,
        config: EvaluationConfig,
        policy: Callable[[Any], PolicyFn],
        steps_per_iteration: int,
    ):
        """
        Args:
            task: the unbatched environment.
            num_train_envs: copies that learn.
            config: settings.
            policy: `policy_params → PolicyFn`, deterministic.
            steps_per_iteration: environment steps of training between two calls of `next_round`.
        """
        self.task = task
        self.num_envs = min(config.num_envs, num_train_envs)
        self._policy = policy
        self._min_updates = -(-config.every_steps // steps_per_iteration)

    def init(self, policy_params: Any, starts: State) -> InlineEvaluation:
        """The first round, under the untrained policy.

        Args:
            policy_params: the policy to begin with.
            starts: at least E fresh resets.
        """
        return InlineEvaluation(
            policy_params=policy_params,
            snapshot_iteration=jnp.zeros((), jnp.int32),
            env=self._first(starts),
            alive=jnp.ones(self.num_envs, bool),
            returns=jnp.zeros(self.num_envs, jnp.float32),
            lengths=jnp.zeros(self.num_envs, jnp.int32),
            best_policy_params=policy_params,
            best_iteration=jnp.zeros((), jnp.int32),
            best_return=jnp.float32(-jnp.inf),
        )

    def act(self, live: InlineEvaluation) -> jax.Array:
        """The snapshot's actions, `[E, action_size]`, in Gymnasium's units."""
        return self._policy(live.policy_params)(live.env.obs, jax.random.PRNGKey(0))

    def record(self, live: InlineEvaluation, env: State) -> InlineEvaluation:
        """Take a step's rewards in. A copy whose episode is over is stepped on, unrecorded, until the round ends."""
        return live.replace(
            env=env,
            returns=live.returns + jnp.where(live.alive, env.reward, 0.0),
            lengths=live.lengths + live.alive,
            alive=live.alive & ~(env.terminated | env.truncated),
        )

    def next_round(
        self, live: InlineEvaluation, policy_params: Any, update: jax.Array, starts: State
    ) -> tuple[InlineEvaluation, Metrics]:
        """Where the round is over, score it and begin the next one with the present policy.

        Args:
            live: the round.
            policy_params: the present policy.
            update: `[] i32`, the number of updates behind it.
            starts: at least E fresh resets.

        Returns:
            The round to go on with; and its scores, NaN where no round has ended: `eval_return`,
            `eval_return_std`, `eval_length`, and `eval_iteration`, the number of updates behind the scored policy.
        """
        is_over = ~live.alive.any() & (update - live.snapshot_iteration >= self._min_updates)
        score = live.returns.mean()
        is_best = is_over & (score > live.best_return)
        scores = {
            "eval_return": score,
            "eval_return_std": live.returns.std(),
            "eval_length": live.lengths.mean(),
            "eval_iteration": jnp.float32(live.snapshot_iteration),
        }
        fresh = self.init(policy_params, starts).replace(snapshot_iteration=update)
        going_on = jax.tree.map(lambda new, old: jnp.where(is_over, new, old), fresh, live)
        best = (live.policy_params, live.snapshot_iteration, score)
        so_far = (live.best_policy_params, live.best_iteration, live.best_return)
        params, best_iteration, best_return = jax.tree.map(lambda new, old: jnp.where(is_best, new, old), best, so_far)
        going_on = going_on.replace(best_policy_params=params, best_iteration=best_iteration, best_return=best_return)
        return going_on, {name: jnp.where(is_over, value, jnp.nan) for name, value in scores.items()}

    def _first(self, starts: State) -> State:
        return jax.tree.map(lambda x: x[: self.num_envs], starts)
