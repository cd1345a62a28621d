"""Episodes in real Gymnasium environments, stepped side by side by one process per core."""

import contextlib
import dataclasses
import logging
import os
import pickle
from subprocess import PIPE, Popen
from types import TracebackType

import numpy as np
from jaxtyping import Bool, Float

from mjx_walk.envs import Task
from mjx_walk.envs.models import warn_of_changed_sources
from mjx_walk.evaluation.gymnasium_worker import send
from mjx_walk.evaluation.perturbations import Perturbation
from mjx_walk.machine.subprocesses import start_module

__all__ = ["MAX_PARALLEL_EPISODES", "ParallelEpisodes", "Steps", "warn_of_differences"]

MAX_PARALLEL_EPISODES = 1024
"""Episodes played at once; an environment takes about 1 MB."""

_LOGGER = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Steps:
    """One step of N episodes. The rows of those that were over before it are meaningless, apart from the flags."""

    obs: Float[np.ndarray, "N observation_size"]
    """Observations after the step, f64."""
    rewards: Float[np.ndarray, " N"]
    """Zero for episodes that were over."""
    terminated: Bool[np.ndarray, " N"]
    truncated: Bool[np.ndarray, " N"]
    infos: dict[str, np.ndarray]
    """`[N, …] f64` each, the entries of Gymnasium's `info`; empty unless they were asked for."""


class ParallelEpisodes:
    """N episodes that have been reset, as a context manager. Its end stops the processes."""

    def __init__(self, task: Task, episodes: list[tuple[int, Perturbation]], with_infos: bool = False):
        """
        Args:
            task: an environment with an equivalent in Gymnasium, and its keywords.
            episodes: seed of the reset, and changed physics, of each episode.
            with_infos: whether steps hold Gymnasium's `info`.
        """
        self._task = task
        self._episodes = episodes
        self._with_infos = with_infos
        self._closing = contextlib.ExitStack()
        self._workers: list[Popen] = []
        self._shares = [s for s in np.array_split(np.arange(len(episodes)), os.cpu_count() or 1) if s.size]

    def __enter__(self) -> "ParallelEpisodes":
        keywords = self._task.gymnasium_kwargs() | {"max_episode_steps": self._task.options.max_episode_steps}
        with contextlib.ExitStack() as started:
            for _ in self._shares:
                # `multiprocessing` would import the user's main module a second time.
                worker = start_module("evaluation.gymnasium_worker", stdin=PIPE, stdout=PIPE)
                self._workers.append(started.enter_context(worker))
            for worker, share in zip(self._workers, self._shares, strict=True):
                episodes = [(seed, tuple(change)) for seed, change in (self._episodes[i] for i in share)]
                _send(worker, (self._task.gymnasium_id, keywords, episodes, self._with_infos))
            self.starts = self._receive_steps()
            """Observations and infos of the resets."""
            self._closing = started.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._closing.__exit__(kind, error, traceback)

    def step(self, actions: Float[np.ndarray, "N action_size"]) -> Steps:
        """Step the episodes that are not over.

        Args:
            actions: f32, in Gymnasium's units.
        """
        for worker, share in zip(self._workers, self._shares, strict=True):
            _send(worker, actions[share])
        return self._receive_steps()

    def _receive_steps(self) -> Steps:
        received = [_receive(worker) for worker in self._workers]
        obs, rewards, terminated, truncated, infos = zip(*received, strict=True)
        return Steps(
            np.concatenate(obs),
            np.concatenate(rewards),
            np.concatenate(terminated),
            np.concatenate(truncated),
            {name: np.concatenate([info[name] for info in infos]) for name in infos[0]},
        )


def warn_of_differences(task: Task) -> None:
    """Log the differences of the real Gymnasium from the training task: another model file, a flat floor.

    Raises:
        UserError: the model file is gone.
    """
    warn_of_changed_sources(task.model_file, task.model_sources)
    if task.ground.is_on:
        _LOGGER.info("Gymnasium's floor is flat; backend=sim scores on the hills")


def _send(worker: Popen, message: object) -> None:
    assert worker.stdin
    send(worker.stdin, message)


def _receive(worker: Popen) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    assert worker.stdout
    try:
        return pickle.load(worker.stdout)
    except EOFError:
        raise RuntimeError("a Gymnasium process ended; its error is above") from None
