"""The recorders of the runs that train in one program, and the step at which these resume together.

A process that is killed while it saves leaves some of its seeds one checkpoint ahead of the others. These go back.
"""

import contextlib
import functools
import logging
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.envs import Task
from mjx_walk.logs.metrics import Row
from mjx_walk.settings.config import Config
from mjx_walk.storage.checkpoint import list_steps, read_meta
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.distributed import Processes
from mjx_walk.training.distributed_checkpoint import SEEDS_TOGETHER
from mjx_walk.training.recorder import Recorder
from mjx_walk.training.summary import score_lines
from mjx_walk.utils.errors import UnreadableError, UserError

__all__ = ["Recorders", "have_saved", "restore_together"]

_LOGGER = logging.getLogger(__name__)


class Recorders:
    """Writes the folders of one or several runs. Arguments of several runs are in the order of the configurations.

    Runs that train together, and the devices of one run, keep their newest checkpoints at the same step.
    """

    def __init__(
        self, configs: list[Config], task: Task, algorithm: Algorithm, folders: list[RunFolder], processes: Processes
    ):
        """
        Args:
            configs: checked configurations that differ only in `seed` and `run_dir`.
            task: the unbatched environment.
            algorithm: algorithm of one run, on one device.
            folders: prepared run folders, one for each configuration.
            processes: processes that train one run.
        """
        self._recorders = [
            Recorder(config, task, algorithm, folder, processes, len(configs))
            for config, folder in zip(configs, folders, strict=True)
        ]
        self._algorithm = algorithm
        self._folders = folders
        self._processes = processes

    def restore(self) -> list[tuple[TrainState, Metadata]]:
        """The newest saved state and its metadata of each run, all at the same step; none if nothing is saved.

        Raises:
            UserError: only some runs have a usable checkpoint, or some have continued alone.
        """
        if have_saved(self._folders):
            return restore_together(self._recorders, self._algorithm.state_shapes())
        for folder in self._folders:
            if folder.metrics.exists():
                warnings.warn(f"{folder.path} has no checkpoint; training restarts from step 0", stacklevel=2)
        return []

    def begin(self, env_steps: int, will_train: bool) -> None:
        """Open the logs, as `Recorder.begin` does."""
        for recorder in self._recorders:
            recorder.begin(env_steps, will_train)

    def write(self, rows: list[Row]) -> None:
        """Log a row of each run."""
        for recorder, row in zip(self._recorders, rows, strict=True):
            recorder.write(row)

    def film(self, policies: list[Any], rows: list[Row]) -> None:
        """Film the policies of the runs in whose row an evaluation ends."""
        for recorder, policy, row in zip(self._recorders, policies, rows, strict=True):
            if "eval/return" in row:
                recorder.film(policy, int(row["env_steps"]))

    def wait_for_saves(self) -> None:
        """Wait until the last save is complete in all folders. Before that, one may need the checkpoint before it."""
        for recorder in self._recorders:
            recorder.wait_for_save()
        self._processes.wait_for_all()

    def save(self, states: list[TrainState], are_finite: Iterable[bool], env_steps: int, wall_seconds: float) -> None:
        """Start saving the states that are finite."""
        for recorder, state, is_finite in zip(self._recorders, states, are_finite, strict=True):
            if is_finite:
                recorder.save(state, env_steps, wall_seconds)

    def end(
        self, states: list[TrainState], env_steps: int, evaluate: Callable[[int, Any], float] | None = None
    ) -> None:
        """Close the logs, draw the curves, and keep the policies that are to be scored.

        Args:
            states: the last TrainState of each run.
            env_steps: their environment steps.
            evaluate: see `Recorder.end`, with the run's seed as its first argument. Without it, training has stopped
                early, and all files are complete when this returns.
        """
        for recorder, state in zip(self._recorders, states, strict=True):
            recorder.end(state, env_steps, evaluate and functools.partial(evaluate, recorder.config.seed))
        if evaluate and len(self._recorders) * self._processes.process_count == 1:
            return  # a single folder is saved while the policies are scored
        self.wait_for_saves()
        for recorder in self._recorders:
            recorder.wait()
            recorder.prune()

    def score(self, training_seconds: float, total_steps: int) -> None:
        """Score every run with `Recorder.score`, and log the scores. On return or error, all files are complete.

        Args:
            training_seconds: seconds of training, equal for all runs in whatever order they are scored.
            total_steps: environment steps of the complete training.
        """
        try:
            for recorder in self._recorders:
                seed = recorder.config.seed if len(self._recorders) > 1 else None
                for line in score_lines(recorder.score(training_seconds), total_steps, seed):
                    _LOGGER.info(line)
        finally:
            for recorder in self._recorders:
                recorder.wait()

    def close(self) -> None:
        """Finish the checkpoints that are being written, and close the logs, however training has ended."""
        with contextlib.ExitStack() as closing:
            for recorder in self._recorders:
                closing.callback(recorder.close)


def have_saved(folders: list[RunFolder]) -> bool:
    """Whether all runs have a checkpoint, so that they resume. Else none has, and they begin again.

    The first checkpoint of some of them does not count, if the others were to get theirs in the same save.

    Raises:
        UserError: some have checkpoints and others have none.
    """
    saved = [list_steps(folder.checkpoints) for folder in folders]
    if all(saved) or not any(saved):
        return all(saved)
    paths = [paths for paths in saved if paths]
    if all(len(own) == 1 and _is_saved_together(own[0], len(folders)) for own in paths):
        return False
    raise _different_steps(int(own[-1].name) if own else 0 for own in saved)


def restore_together(recorders: Sequence[Recorder], like: TrainState) -> list[tuple[TrainState, Metadata]]:
    """The newest saved state and its metadata of each run, all at the same step.

    Args:
        recorders: of the runs.
        like: TrainState of shapes and dtypes.

    Raises:
        UserError: a run has no usable checkpoint, or some have continued alone.
    """
    restored = [recorder.restore(like) for recorder in recorders]
    steps = [metadata["env_steps"] for _, metadata in restored]
    first = min(steps)
    ahead = [i for i, step in enumerate(steps) if step > first]
    for i in ahead:
        if restored[i][1].get(SEEDS_TOGETHER) != len(recorders):
            raise _different_steps(steps)
        restored[i] = recorders[i].restore(like, at_most=first)
        if restored[i][1]["env_steps"] != first:
            raise _different_steps(steps)
    if ahead:
        warnings.warn(f"not all seeds were saved at step {max(steps):,}; all resume from step {first:,}", stacklevel=2)
    return restored


def _is_saved_together(path: Path, num_seeds: int) -> bool:
    try:
        return read_meta(path).get(SEEDS_TOGETHER) == num_seeds
    except UnreadableError:
        raise
    except ValueError:
        return False


def _different_steps(steps: Iterable[int]) -> UserError:
    at = ", ".join(f"{step:,}" for step in sorted(set(steps)))
    return UserError(f"the seeds are at different steps ({at}); resume each alone")
