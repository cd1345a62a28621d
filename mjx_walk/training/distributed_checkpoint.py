"""Checkpoints of a run on several devices: the main process's in the run's folder, the others' in subfolders."""

from pathlib import Path
from typing import Final

import jax
import jax.numpy as jnp

from mjx_walk.algos import TrainState
from mjx_walk.storage import checkpoint
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.training.distributed import Processes
from mjx_walk.utils.types import map_leaves_with

__all__ = ["NUM_DEVICES", "SEEDS_TOGETHER", "device_folder", "restore_newest"]

NUM_DEVICES: Final = "num_devices"
"""Key of a checkpoint's metadata: the number of devices that saved it."""
SEEDS_TOGETHER: Final = "seeds_together"
"""Key of a checkpoint's metadata: the number of runs that trained in one program."""


def device_folder(checkpoints: Path, process_index: int) -> Path:
    """The folder of a device's checkpoints."""
    return checkpoints / f"device_{process_index}" if process_index else checkpoints


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
