"""Run a policy: collect training data, or play complete episodes."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int32, PRNGKeyArray

from mjx_walk.common.inline_evaluation import InlineEvaluation, InlineEvaluator
from mjx_walk.envs import TrainableTask
from mjx_walk.envs.vector_env import Outcome, VectorEnv, VectorState
from mjx_walk.utils.types import Metrics, PolicyFn, PyTree

__all__ = ["Actor", "Step", "evaluate", "unroll"]

_InputsT = TypeVar("_InputsT")
_ExtrasT = TypeVar("_ExtrasT")
_KeptT = TypeVar("_KeptT")

Actor = Callable[[Float[Array, "B observation_size"], _InputsT], tuple[Float[Array, "B action_size"], _ExtrasT]]
"""`(obs, inputs of the step) → (action in Gymnasium's units, extras)`."""


class Step(NamedTuple):
    """One step of all environments, `[B, …]`; stacked over time, `[T, B, …]`."""

    obs: Array
    action: Array
    outcome: Outcome
    extras: PyTree
    """Of the actor."""


def unroll(
    env: VectorEnv,
    evaluator: InlineEvaluator,
    state: VectorState,
    evaluation: InlineEvaluation,
    actor: Actor[_InputsT, _ExtrasT],
    inputs: _InputsT,
    keep: Callable[[Step], _KeptT],
) -> tuple[VectorState, InlineEvaluation, _KeptT, Metrics]:
    """Step all environments T times.

    Args:
        env: the environments that train.
        evaluator: steps the inline evaluation with them.
        state: their state.
        evaluation: state of the inline evaluation.
        actor: chooses actions.
        inputs: `[T]` random keys, or a tree of `[T, …]`, for the actor.
        keep: what of each step to store; whatever it drops takes no memory.

    Returns:
        The next state and evaluation; what was kept, `[T, B, …]`; and the metrics of `VectorEnv.step`, summed.
    """

    def one(carry, step_inputs):
        state, evaluation = carry
        obs = state.env.obs
        action, extras = actor(obs, step_inputs)
        state, evaluation, outcome, metrics = evaluator.step(env, state, evaluation, action)
        return (state, evaluation), (keep(Step(obs, action, outcome, extras)), metrics)

    (state, evaluation), (kept, metrics) = jax.lax.scan(one, (state, evaluation), inputs)
    return state, evaluation, kept, jax.tree.map(lambda x: x.sum(0), metrics)


def evaluate(
    task: TrainableTask, num_episodes: int, policy: PolicyFn, key: PRNGKeyArray
) -> tuple[
    Float[Array, " {num_episodes}"], Int32[Array, " {num_episodes}"], dict[str, Float[Array, " {num_episodes}"]]
]:
    """Play complete episodes in one batch, until the last of them has ended.

    Args:
        task: the unbatched environment.
        num_episodes: environments, which play one episode each.
        policy: usually deterministic.
        key: for the starts and, if the policy samples, the actions.

    Returns:
        Undiscounted returns; lengths in steps; and the means of the task's measures over the steps of each episode.
    """
    reset_key, run_key = jax.random.split(key)
    start = jax.vmap(task.reset)(jax.random.split(reset_key, num_episodes))

    def is_running(carry):
        _, alive, _, _, _ = carry
        return alive.any()

    def step(carry):
        before, alive, returns, lengths, sums = carry
        key = jax.random.fold_in(run_key, lengths.max())
        state = jax.vmap(task.step)(before, policy(before.obs, key))
        returns += jnp.where(alive, state.reward, 0.0)
        measured = jax.vmap(task.measures)(before, state)
        sums = {name: sums[name] + jnp.where(alive, value, 0.0) for name, value in measured.items()}
        lengths += alive
        return state, alive & ~(state.terminated | state.truncated), returns, lengths, sums

    zeros = jnp.zeros(num_episodes, jnp.float32)
    sums = dict.fromkeys(jax.eval_shape(jax.vmap(task.measures), start, start), zeros)
    carry = (start, jnp.ones(num_episodes, bool), zeros, zeros.astype(jnp.int32), sums)
    _, _, returns, lengths, sums = jax.lax.while_loop(is_running, step, carry)
    return returns, lengths, {name: value / lengths for name, value in sums.items()}
