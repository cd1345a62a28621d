"""The policies that a training ends with, and their scores in the real Gymnasium."""

import functools
import logging
from collections.abc import Callable

import jax

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.common.rollout import evaluate
from mjx_walk.evaluation.gymnasium_scores import score_in_gymnasium
from mjx_walk.evaluation.saved_policies import best_policy, deterministic_act, in_float32
from mjx_walk.machine.signals import undisturbed
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, FINAL, Scores, write_scores
from mjx_walk.training.messages import score_lines
from mjx_walk.training.milestones import KeptPolicies, Snapshots, find_milestones
from mjx_walk.training.recorder import reporting_failed_writes
from mjx_walk.utils.types import PolicyParams

__all__ = ["closing_policies", "score_run", "score_runs"]

_LOGGER = logging.getLogger(__name__)

_CLOSING_EVALUATION = 2**31 - 1
"""Folded into a run's seed, so that the evaluation at the end has its own episodes."""


def closing_policies(
    algorithm: Algorithm,
    states: list[TrainState],
    snapshots: list[Snapshots | None],
    seeds: list[int],
    env_steps: int,
    steps_per_iteration: int,
) -> list[KeptPolicies]:
    """The final policy, the best one and the milestones of each run that has trained to its end.

    Inline evaluation has not scored the final policy. It is evaluated here, in as many environments. If its return is
    the highest, the final policy is also the best, and one object has both names.

    Args:
        algorithm: algorithm of one run.
        states: the last TrainState of each run.
        snapshots: policies of each run from which the milestones are chosen; None for a run that keeps none.
        seeds: their seeds.
        env_steps: their environment steps.
        steps_per_iteration: environment steps of an iteration, over all devices.
    """
    evaluation = jax.jit(functools.partial(_mean_return, algorithm))
    found: list[KeptPolicies] = []
    for seed, state, own in zip(seeds, states, snapshots, strict=True):
        params = algorithm.policy_params(state)
        key = jax.random.fold_in(jax.random.PRNGKey(seed), _CLOSING_EVALUATION)
        score = _undisturbed_return(evaluation, key, "the final policy", params)
        metadata: Metadata = {"env_steps": env_steps, "eval_return": score}
        final, best = (params, metadata), best_policy(state, steps_per_iteration)
        best = final if best is None or score > best[1]["eval_return"] else best
        mean_return = functools.partial(_undisturbed_return, evaluation, key, "a snapshot")
        milestones = find_milestones(own, best[1], mean_return) if own else {}
        found.append({FINAL: final, BEST: best, **milestones})
    return found


def _undisturbed_return(
    evaluation: Callable[[PolicyParams, jax.Array], jax.Array], key: jax.Array, whose: str, policy_params: PolicyParams
) -> float:
    """Mean return of a policy. A signal takes effect after its evaluation."""
    with undisturbed(f"finishing the evaluation of {whose}"):
        return float(evaluation(policy_params, key))


def _mean_return(algorithm: Algorithm, policy_params: PolicyParams, key: jax.Array) -> jax.Array:
    """Mean return of a policy in as many environments as the inline evaluation has."""
    returns, *_ = evaluate(algorithm.task, algorithm.evaluator.num_envs, algorithm.policy(policy_params), key)
    return returns.mean()


def score_runs(
    algorithm: Algorithm,
    policies: list[KeptPolicies],
    folders: list[RunFolder],
    seeds: list[int],
    num_episodes: int,
    training_seconds: float,
    total_steps: int,
) -> None:
    """Score the policies of each run, and log their scores.

    Args:
        algorithm: algorithm of one run.
        policies: policies of each run.
        folders: folder of each run.
        seeds: seed of each run.
        num_episodes: as for `score_run`.
        training_seconds: as for `score_run`.
        total_steps: environment steps of the complete training of a run.
    """
    acting = in_float32(algorithm)
    for own, folder, seed in zip(policies, folders, seeds, strict=True):
        scored = score_run(acting, own, folder, num_episodes, training_seconds)
        for line in score_lines(scored, total_steps, seed if len(seeds) > 1 else None):
            _LOGGER.info(line)


def score_run(
    acting: Algorithm, policies: KeptPolicies, folder: RunFolder, num_episodes: int, training_seconds: float
) -> dict[str, tuple[Scores, int]]:
    """Score the final and the best policy of a run in the real Gymnasium, and write `eval_gymnasium.json`.

    The best policy was chosen by other episodes than those that are scored here.

    Args:
        acting: result of `in_float32`.
        policies: the run's policies, by name.
        folder: the run's folder.
        num_episodes: episodes of each policy.
        training_seconds: seconds of training, equal for all runs in whatever order they are scored.

    Returns:
        The scores and the environment steps of each policy, by its name.
    """
    scored: dict[str, tuple[Scores, int]] = {}
    for name in (FINAL, BEST):
        policy = policies[name]
        if scored and policy is policies[FINAL]:
            scored[name] = scored[FINAL]
            continue
        params, metadata = policy
        scores = score_in_gymnasium(acting.task, deterministic_act(acting, params), num_episodes)
        scored[name] = (scores, metadata["env_steps"])
    blocks = {name: scores.block(**policies[name][1]) for name, (scores, _) in scored.items()}
    with reporting_failed_writes(folder):
        write_scores(folder.gymnasium_scores, acting.task.gymnasium_id, blocks, {"wall_seconds": training_seconds})
    return scored
