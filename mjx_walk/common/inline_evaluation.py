"""Deterministic evaluation inside the training batch: a few more environments, which a frozen policy controls.

A step of few environments takes a GPU nearly as long as one of many. An evaluation of its own would therefore cost a
third of a million training steps; inside the batch it costs its share of the environments.
"""

import dataclasses
from collections.abc import Callable

import flax
import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.envs import BaseTask, State
from mjx_walk.envs.vector_env import Outcome, VectorEnv, VectorState
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import ITERATION_COUNT, Metric, Metrics, PolicyFn, PolicyParams, Reduction

__all__ = ["NO_RETURN", "EvaluationConfig", "InlineEvaluation", "InlineEvaluator"]


@dataclasses.dataclass
class EvaluationConfig:
    """Settings of the deterministic evaluation."""

    num_envs: int = setting(128, at_least=1)
    """Environments that play complete episodes without noise; at most the number of training environments."""
    every_steps: int = setting(0, at_least=0)
    """Minimum number of environment steps from the start of one round to the start of the next."""
    gymnasium_episodes: int = setting(100, at_least=0)
    """Episodes in the real Gymnasium after training; 0 skips this."""
    films: bool = False
    """Film an episode in the real Gymnasium after each round, into `films/` and for TensorBoard."""


NO_RETURN = float(np.finfo(np.float32).min)
"""The lowest float32, which is finite, so that `JAX_DEBUG_INFS=1` stops only at faults."""


class InlineEvaluation(flax.struct.PyTreeNode):
    """One round of episodes under a snapshot of the policy, and the best snapshot so far."""

    policy_params: PolicyParams
    snapshot_iteration: jax.Array = flax.struct.field(metadata=ITERATION_COUNT)
    """`[] i32`: iterations before the snapshot was taken."""
    env: State
    """`[E, …]`."""
    alive: jax.Array
    """`[E] bool`: the episode of this round has not ended."""
    returns: jax.Array
    """`[E] f32`."""
    lengths: jax.Array
    """`[E] i32`."""
    best_policy_params: PolicyParams
    best_iteration: jax.Array = flax.struct.field(metadata=ITERATION_COUNT)
    """`[] i32`: iterations before the best snapshot was taken."""
    best_return: jax.Array
    """`[] f32`, `NO_RETURN` before the first round has ended."""


class InlineEvaluator:
    """Rounds of one episode in each environment; a round lasts until its slowest environment has finished."""

    def __init__(
        self,
        task: BaseTask,
        num_train_envs: int,
        config: EvaluationConfig,
        policy: Callable[[PolicyParams], PolicyFn],
        steps_per_iteration: int,
    ):
        """
        Args:
            task: the unbatched environment.
            num_train_envs: number of environments that train.
            config: settings.
            policy: `policy_params → PolicyFn`, deterministic.
            steps_per_iteration: environment steps of training between two calls of `next_round`.
        """
        self.task = task
        self.num_envs = min(config.num_envs, num_train_envs)
        self._policy = policy
        self._min_iterations = -(-config.every_steps // steps_per_iteration)

    def init(self, policy_params: PolicyParams, starts: State) -> InlineEvaluation:
        """The first round, under the untrained policy.

        Args:
            policy_params: the policy to evaluate.
            starts: at least E fresh resets, whose step counts do not matter.
        """
        env = jax.tree.map(lambda x: x[: self.num_envs], starts)
        return InlineEvaluation(
            policy_params=policy_params,
            snapshot_iteration=jnp.zeros((), jnp.int32),
            env=env.replace(steps=jnp.zeros_like(env.steps)),
            alive=jnp.ones(self.num_envs, bool),
            returns=jnp.zeros(self.num_envs, jnp.float32),
            lengths=jnp.zeros(self.num_envs, jnp.int32),
            best_policy_params=policy_params,
            best_iteration=jnp.zeros((), jnp.int32),
            best_return=jnp.float32(NO_RETURN),
        )

    def step(
        self, env: VectorEnv, state: VectorState, evaluation: InlineEvaluation, action: jax.Array
    ) -> tuple[VectorState, InlineEvaluation, Outcome, Metrics]:
        """Step the environments that train and those of the round in one physics call.

        Args:
            env: the environments that train.
            state: their state.
            evaluation: the present round, whose environments the snapshot controls.
            action: `[B, action_size] f32` of the environments that train, in Gymnasium's units.

        Returns:
            The next state; the next evaluation; and outcome and metrics of `VectorEnv.step`.
        """
        own_action = self._policy(evaluation.policy_params)(evaluation.env.obs, jax.random.PRNGKey(0))
        state, own, outcome, metrics = env.step(state, action, evaluation.env, own_action)
        return state, _record(evaluation, own), outcome, metrics

    def next_round(
        self, evaluation: InlineEvaluation, policy_params: PolicyParams, iteration: jax.Array, starts: State
    ) -> tuple[InlineEvaluation, Metrics]:
        """Score a round that has ended, and start the next one with the present policy.

        Args:
            evaluation: the present round.
            policy_params: the present policy.
            iteration: `[] i32`, iterations so far.
            starts: at least E fresh resets, whose step counts do not matter.

        Returns:
            The round to continue; and its scores, which have a value where a round has ended: `eval_return`,
            `eval_return_std`, `eval_length`, and `eval_iteration`, the iterations before the scored policy.
        """
        is_late_enough = iteration - evaluation.snapshot_iteration >= self._min_iterations
        is_over = ~evaluation.alive.any() & is_late_enough
        score = evaluation.returns.mean()
        is_best = is_over & (score > evaluation.best_return)
        scores = {
            "eval_return": score,
            "eval_return_std": evaluation.returns.std(),
            "eval_length": evaluation.lengths.mean(),
            "eval_iteration": jnp.float32(evaluation.snapshot_iteration),
        }
        fresh = self.init(policy_params, starts).replace(snapshot_iteration=iteration)
        present = jax.tree.map(lambda new, old: jnp.where(is_over, new, old), fresh, evaluation)
        snapshot = (evaluation.policy_params, evaluation.snapshot_iteration, score)
        best = (evaluation.best_policy_params, evaluation.best_iteration, evaluation.best_return)
        params, best_iteration, best_return = jax.tree.map(
            lambda new, old: jnp.where(is_best, new, old), snapshot, best
        )
        present = present.replace(best_policy_params=params, best_iteration=best_iteration, best_return=best_return)
        return present, {name: Metric(value, Reduction.FIRST_DEVICE).only_if(is_over) for name, value in scores.items()}


def _record(evaluation: InlineEvaluation, env: State) -> InlineEvaluation:
    """Add the rewards of one step. Environments whose episode has ended are stepped, but not recorded."""
    return evaluation.replace(
        env=env,
        returns=evaluation.returns + jnp.where(evaluation.alive, env.reward, 0.0),
        lengths=evaluation.lengths + evaluation.alive,
        alive=evaluation.alive & ~(env.terminated | env.truncated),
    )
