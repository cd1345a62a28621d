"""Scores of a policy: in the real Gymnasium, or in a run's own engine."""

import contextlib
import dataclasses
import logging
import os
import pickle
from collections.abc import Callable
from subprocess import PIPE, Popen
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from mjx_walk.common.rollout import evaluate
from mjx_walk.envs import Task
from mjx_walk.envs.models import warn_of_changed_sources
from mjx_walk.envs.randomization.options import Randomization
from mjx_walk.evaluation.gymnasium_worker import send
from mjx_walk.evaluation.perturbations import Perturbation
from mjx_walk.logs.progress import ScoringProgress
from mjx_walk.machine.signals import undisturbed
from mjx_walk.machine.subprocesses import start_module
from mjx_walk.storage.scores import Scores
from mjx_walk.utils.setting_fields import MAX_SEED, setting
from mjx_walk.utils.types import Act, PolicyFn

__all__ = ["Episodes", "ScoreRequest", "compile_episodes", "play_in_gymnasium", "score_in_gymnasium", "score_in_sim"]

_MAX_PARALLEL_EPISODES = 1024
"""Episodes played at once; an environment takes about 1 MB."""


@dataclasses.dataclass
class ScoreRequest:
    """Policy, task and episodes that a user asks to be scored."""

    episodes: int = setting(100, at_least=1)
    backend: str = setting("gymnasium", choices=("gymnasium", "sim"))
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)


_LOGGER = logging.getLogger(__name__)

Episodes = Callable[[jax.Array, int], tuple[jax.Array, jax.Array, dict[str, jax.Array]]]
"""`key, N → returns [N] f32, lengths [N] i32, means of the task's measures [N] f32`."""


def score_in_gymnasium(task: Task, act: Act, num_episodes: int, seed: int = 0) -> Scores:
    """Score complete episodes in `gymnasium.make`: MuJoCo on the CPU, in float64, with the model's own solver.

    One process per core plays the episodes. A task without an equivalent in Gymnasium is scored in its own engine,
    with its original physics.

    Args:
        task: the environment and its keywords.
        act: a JAX function `[N, observation_size] f32 → [N, action_size] f32`, both in Gymnasium's units.
        num_episodes: N.
        seed: episode i is reset with `seed + i`. Seeds that differ by fewer than N share episodes.

    Raises:
        UserError: the model file is gone.
    """
    if not task.is_in_gymnasium:
        if task.randomizer.is_on:
            task = type(task)(dataclasses.replace(task.options, randomize=Randomization()), task.engine.name)
        return score_in_sim(task, compile_episodes(task, lambda obs, key: act(obs)), num_episodes, seed)
    seeds = [int(seed) + i for i in range(num_episodes)]  # Gymnasium refuses NumPy's integers
    returns, lengths = play_in_gymnasium(task, act, seeds)
    return Scores(returns, lengths, seeds, task.gymnasium_id)


def play_in_gymnasium(
    task: Task, act: Act, seeds: list[int], changes: list[Perturbation] | None = None
) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Play one episode per seed; their returns and lengths.

    Args:
        task: an environment with an equivalent in Gymnasium, and its keywords.
        act: as for `score_in_gymnasium`.
        seeds: of the resets, N.
        changes: changed physics of each episode, N; by default none.

    Raises:
        UserError: the model file is gone.
    """
    warn_of_changed_sources(task.model_file, task.model_sources)
    if task.ground.is_on:
        _LOGGER.info("Gymnasium's floor is flat; backend=sim scores on the hills")
    episodes = list(zip(seeds, changes or [Perturbation()] * len(seeds), strict=True))
    rounds = [episodes[i : i + _MAX_PARALLEL_EPISODES] for i in range(0, len(episodes), _MAX_PARALLEL_EPISODES)]
    with contextlib.closing(ScoringProgress(len(episodes), len(rounds) * task.max_episode_steps)) as progress:
        played = [_play_round(task, act, some, progress, number) for number, some in enumerate(rounds)]
    returns, lengths = zip(*played, strict=True)
    return np.concatenate(returns), np.concatenate(lengths)


def _play_round(
    task: Task, act: Act, episodes: list[tuple[int, Perturbation]], progress: ScoringProgress, rounds_before: int
) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Play episodes in parallel, each with its seed and its changes; their returns and lengths."""
    steps_before = rounds_before * task.max_episode_steps
    keywords = task.gymnasium_kwargs() | {"max_episode_steps": task.options.max_episode_steps}
    returns, lengths = np.zeros(len(episodes)), np.zeros(len(episodes), np.int64)
    is_over = np.zeros(len(episodes), bool)
    shares = [share for share in np.array_split(np.arange(len(episodes)), os.cpu_count() or 1) if share.size]
    with contextlib.ExitStack() as stack:
        # `multiprocessing` would import the user's main module a second time.
        workers = [
            stack.enter_context(start_module("evaluation.gymnasium_worker", stdin=PIPE, stdout=PIPE)) for _ in shares
        ]
        for worker, share in zip(workers, shares, strict=True):
            _send(
                worker,
                (task.gymnasium_id, keywords, [(seed, tuple(change)) for seed, change in (episodes[i] for i in share)]),
            )
        obs = np.concatenate([_receive(worker) for worker in workers])
        while not is_over.all():
            actions = np.asarray(act(obs.astype(np.float32)))
            lengths += ~is_over
            for worker, share in zip(workers, shares, strict=True):
                _send(worker, actions[share])
            for worker, share in zip(workers, shares, strict=True):
                obs[share], rewards, is_over[share] = _receive(worker)
                returns[share] += rewards
            num_before = rounds_before * _MAX_PARALLEL_EPISODES
            progress.update(steps_before + int(lengths.max()), num_before + int(is_over.sum()))
    return returns, lengths


def _send(worker: Popen, message: object) -> None:
    assert worker.stdin
    send(worker.stdin, message)


def _receive(worker: Popen) -> Any:
    assert worker.stdout
    try:
        return pickle.load(worker.stdout)
    except EOFError:
        raise RuntimeError("a Gymnasium process ended; its error is above") from None


def compile_episodes(task: Task, policy: PolicyFn) -> Episodes:
    """Compile complete episodes in the task's own engine, once for each number of episodes."""
    return jax.jit(lambda key, num_episodes: evaluate(task, num_episodes, policy, key), static_argnums=1)


def score_in_sim(task: Task, episodes: Episodes, num_episodes: int, seed: int = 0) -> Scores:
    """Score complete episodes in the task's own engine, all in one batch.

    Args:
        task: the environment.
        episodes: see `compile_episodes`.
        num_episodes: N.
        seed: of the starts.
    """
    with undisturbed("finishing the episodes"):
        found = jax.block_until_ready(episodes(jax.random.PRNGKey(seed), num_episodes))
    returns, lengths, measures = jax.tree.map(np.asarray, found)
    name = f"{task.gymnasium_id} on {task.engine.name}" + (", on hills" if task.ground.is_on else "")
    if measures and task.terminates_on_fall:
        measures["falls (%)"] = 100 * (lengths < task.max_episode_steps)
    means = {measure: np.asarray(values, np.float64) for measure, values in measures.items()}
    return Scores(np.asarray(returns, np.float64), np.asarray(lengths, np.int64), [seed], name, means)
