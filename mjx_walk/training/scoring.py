"""The policies that a training ends with, and their scores in the real Gymnasium."""

import functools

import jax

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.common.rollout import evaluate
from mjx_walk.evaluation.gymnasium_scores import score_in_gymnasium
from mjx_walk.evaluation.saved_policies import best_policy, deterministic_act
from mjx_walk.machine.signals import undisturbed
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, FINAL, Scores, write_scores
from mjx_walk.training.recorder import reporting_failed_writes
from mjx_walk.utils.types import PolicyParams

__all__ = ["Policies", "final_and_best", "score_run"]

_CLOSING_EVALUATION = 2**31 - 1
"""Folded into a run's seed, so that the evaluation at the end has its own episodes."""

Policies = dict[str, tuple[PolicyParams, Metadata]]
"""The `final` and the `best` policy of a run. One object under both names if the final policy is also the best."""


def final_and_best(
    algorithm: Algorithm, states: list[TrainState], seeds: list[int], env_steps: int, steps_per_iteration: int
) -> list[Policies]:
    """The policies of each run that has trained to its end.

    Inline evaluation has not scored the final policy. It is evaluated here, in as many environments. If its return is
    the highest, the final policy is also the best.

    Args:
        algorithm: algorithm of one run.
        states: the last TrainState of each run.
        seeds: their seeds.
        env_steps: their environment steps.
        steps_per_iteration: environment steps of an iteration, over all devices.
    """
    mean_return = jax.jit(functools.partial(_mean_return, algorithm))
    found: list[Policies] = []
    for seed, state in zip(seeds, states, strict=True):
        params = algorithm.policy_params(state)
        key = jax.random.fold_in(jax.random.PRNGKey(seed), _CLOSING_EVALUATION)
        with undisturbed("finishing the evaluation of the final policy"):
            score = float(mean_return(params, key))
        metadata: Metadata = {"env_steps": env_steps, "eval_return": score}
        final, best = (params, metadata), best_policy(state, steps_per_iteration)
        found.append({FINAL: final, BEST: final if best is None or score > best[1]["eval_return"] else best})
    return found


def _mean_return(algorithm: Algorithm, policy_params: PolicyParams, key: jax.Array) -> jax.Array:
    """Mean return of a policy in as many environments as the inline evaluation has."""
    returns, *_ = evaluate(algorithm.task, algorithm.evaluator.num_envs, algorithm.policy(policy_params), key)
    return returns.mean()


def score_run(
    acting: Algorithm, policies: Policies, folder: RunFolder, num_episodes: int, training_seconds: float
) -> dict[str, tuple[Scores, int]]:
    """Score the policies of a run in the real Gymnasium, and write `eval_gymnasium.json`.

    The best policy was chosen by other episodes than those that are scored here.

    Args:
        acting: result of `in_float32`.
        policies: the run's policies.
        folder: the run's folder.
        num_episodes: episodes of each policy.
        training_seconds: seconds of training, equal for all runs in whatever order they are scored.

    Returns:
        The scores and the environment steps of each policy, by its name.
    """
    scored: dict[str, tuple[Scores, int]] = {}
    for name, policy in policies.items():
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
