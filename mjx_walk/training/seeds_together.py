"""The step at which seeds that train together resume.

A process that is killed while it saves leaves some of its seeds one checkpoint ahead of the others. These go back.
"""

import warnings
from collections.abc import Iterable
from pathlib import Path

from mjx_walk.algos import TrainState
from mjx_walk.storage.checkpoint import list_steps, read_meta
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.distributed_checkpoint import SEEDS_TOGETHER
from mjx_walk.training.recorder import Recorder
from mjx_walk.utils.errors import UnreadableError, UserError

__all__ = ["have_saved", "restore_together"]


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


def restore_together(recorders: list[Recorder], like: TrainState) -> list[tuple[TrainState, Metadata]]:
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
