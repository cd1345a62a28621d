"""The checkpoints from which runs resume, on any number of devices, and together with other seeds.

The main process's checkpoints are in the run's folder, and those of other devices in subfolders. A process that is
killed while it saves leaves some of its seeds one checkpoint ahead of the others. These go back.
"""

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import jax
import jax.numpy as jnp

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.storage import checkpoint
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.distributed import Processes
from mjx_walk.utils.errors import UnreadableError, UserError
from mjx_walk.utils.types import map_leaves_with

__all__ = [
    "NUM_DEVICES",
    "SEEDS_TOGETHER",
    "device_folder",
    "have_saved",
    "restore_newest",
    "restore_runs",
    "restore_together",
]

NUM_DEVICES: Final = "num_devices"
"""Key of a checkpoint's metadata: the number of devices that saved it."""
SEEDS_TOGETHER: Final = "seeds_together"
"""Key of a checkpoint's metadata: the number of runs that trained in one program."""


def device_folder(checkpoints: Path, process_index: int) -> Path:
    """The folder of a device's checkpoints."""
    return checkpoints / f"device_{process_index}" if process_index else checkpoints


def restore_runs(
    folders: list[RunFolder], algorithm: Algorithm, processes: Processes
) -> list[tuple[TrainState, Metadata]]:
    """The newest saved state and its metadata of each run, all at the same step; none if nothing is saved.

    Args:
        folders: folders of the runs that train in one program.
        algorithm: algorithm of one run, on one device.
        processes: processes that train one run.

    Raises:
        UserError: only some runs have a usable checkpoint, or some have continued alone.
    """
    if have_saved(folders):
        return restore_together([folder.checkpoints for folder in folders], algorithm.state_shapes(), processes)
    for folder in folders:
        if folder.metrics.exists():
            warnings.warn(f"{folder.path} has no checkpoint; training restarts from step 0", stacklevel=2)
    return []


def have_saved(folders: list[RunFolder]) -> bool:
    """Whether all runs have a checkpoint, so that they resume. Else none has, and they begin again.

    The first checkpoint of some of them does not count, if the others were to get theirs in the same save.

    Raises:
        UserError: some have checkpoints and others have none.
    """
    saved = [checkpoint.list_steps(folder.checkpoints) for folder in folders]
    if all(saved) or not any(saved):
        return all(saved)
    paths = [paths for paths in saved if paths]
    if all(len(own) == 1 and _is_saved_together(own[0], len(folders)) for own in paths):
        return False
    raise _different_steps(int(own[-1].name) if own else 0 for own in saved)


def restore_together(
    checkpoints: list[Path], like: TrainState, processes: Processes
) -> list[tuple[TrainState, Metadata]]:
    """The newest saved state and its metadata of each run, all at the same step.

    Args:
        checkpoints: folders of the runs' checkpoints.
        like: TrainState of shapes and dtypes.
        processes: processes that train one run.

    Raises:
        UserError: a run has no usable checkpoint, or some have continued alone.
    """
    restored = [restore_newest(path, like, processes) for path in checkpoints]
    steps = [metadata["env_steps"] for _, metadata in restored]
    first = min(steps)
    ahead = [i for i, step in enumerate(steps) if step > first]
    for i in ahead:
        if restored[i][1].get(SEEDS_TOGETHER) != len(checkpoints):
            raise _different_steps(steps)
        restored[i] = restore_newest(checkpoints[i], like, processes, at_most=first)
        if restored[i][1]["env_steps"] != first:
            raise _different_steps(steps)
    if ahead:
        warnings.warn(f"not all seeds were saved at step {max(steps):,}; all resume from step {first:,}", stacklevel=2)
    return restored


def _is_saved_together(path: Path, num_seeds: int) -> bool:
    try:
        return checkpoint.read_meta(path).get(SEEDS_TOGETHER) == num_seeds
    except UnreadableError:
        raise
    except ValueError:
        return False


def _different_steps(steps: Iterable[int]) -> UserError:
    at = ", ".join(f"{step:,}" for step in sorted(set(steps)))
    return UserError(f"the seeds are at different steps ({at}); resume each alone")


def restore_newest(
    checkpoints: Path, like: TrainState, processes: Processes, at_most: int | None = None
) -> tuple[TrainState, Metadata]:
    """The newest checkpoint that is complete on all devices, for as many devices as there are now.

    A device that joins starts with a copy of another one's part, under random keys of its own. The parts of devices
    that left stay unused.

    Args:
        checkpoints: folder of the run's checkpoints.
        like: TrainState of shapes and dtypes.
        processes: processes of the run.
        at_most: environment steps that the checkpoint may have at most.

    Raises:
        UserError: there is none, or it belongs to another run.
    """
    index, count = processes.process_index, processes.process_count

    def part(path: Path) -> Path:
        metadata = checkpoint.read_meta(path)
        if "wall_seconds" not in metadata:
            raise ValueError(f"{path} is damaged: its metadata lack wall_seconds")
        former_count = metadata.get(NUM_DEVICES, 1)
        return device_folder(checkpoints, index % former_count) / path.name

    def agree(is_complete: bool) -> bool:
        return all(processes.all_gather(is_complete))

    state, metadata = checkpoint.restore_newest(checkpoints, like, part, agree, at_most)
    former_count = metadata.get(NUM_DEVICES, 1)
    if index >= former_count:
        state = map_leaves_with(lambda key: jax.random.fold_in(key, index), "random_key", state)
    if former_count != count:
        state = _rescale_counts(state, former_count, count)
    return state, metadata


def _rescale_counts(state: TrainState, former_count: int, count: int) -> TrainState:
    """Iteration counts for another number of devices: the more devices, the fewer iterations for the same steps."""
    return map_leaves_with(lambda number: jnp.int32(number * former_count // count), "iteration_count", state)
