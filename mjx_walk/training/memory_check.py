"""Check that a run fits into memory and on disk before it allocates anything."""

import shutil
from pathlib import Path

from mjx_walk.algos import Algorithm
from mjx_walk.machine.devices import device_memory, num_bytes
from mjx_walk.utils.errors import UserError

__all__ = ["check_replay"]

_USABLE = 0.9
"""Maximum fraction of the device's memory for the replay buffer."""


def check_replay(algorithm: Algorithm, run_dir: Path, num_runs: int = 1) -> str | None:
    """Memory and disk space that the replay buffer needs, as a line to print.

    Args:
        algorithm: the algorithm, with its replay size.
        run_dir: run folder; it need not exist.
        num_runs: number of seeds in one process.

    Returns:
        One line, or None if the algorithm has no replay buffer.

    Raises:
        UserError: the replay buffer or its checkpoints do not fit.
    """
    if not algorithm.replay_bytes:
        return None
    replay_bytes = num_runs * algorithm.replay_bytes
    checkpoint_bytes = num_runs * num_bytes(algorithm.state_shapes())
    replay, disk = f"{replay_bytes / 1e9:,.2f} GB", f"{2 * checkpoint_bytes / 1e9:,.2f} GB"
    memory = device_memory()
    if replay_bytes > _USABLE * memory:
        fewer = " or train fewer seeds in one process (compare: together=1)" if num_runs > 1 else ""
        raise UserError(
            f"the replay buffer needs {replay}, but the device has {memory / 1e9:,.2f} GB; "
            f"lower algo.replay_capacity{fewer}"
        )
    existing = next(path for path in (run_dir.absolute(), *run_dir.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if 2 * checkpoint_bytes > free:
        raise UserError(
            f"checkpoints with the replay buffer need {disk} of disk space, but {existing} has "
            f"{free / 1e9:,.2f} GB free; lower algo.replay_capacity or choose another run_dir"
        )
    return f"Replay buffer: {replay} of device memory, and up to {disk} of disk space while a checkpoint is replaced."
