"""Check that a run fits memory and disk, before anything is allocated."""

import shutil
from pathlib import Path

import jax

from mjx_walk.algos import Algorithm
from mjx_walk.utils.devices import device_memory, num_bytes
from mjx_walk.utils.errors import UserError

_USABLE = 0.9
"""Fraction of the device's memory that a replay may use."""


def check_replay(algorithm: Algorithm, run_dir: Path, num_runs: int = 1) -> str | None:
    """Memory and disk that a replay needs, as a line to print.

    Args:
        algorithm: what is to run.
        run_dir: where it is to be saved; it need not exist.
        num_runs: how many are to run side by side.

    Returns:
        One line, or None where there is no replay.

    Raises:
        UserError: it does not fit.
    """
    if not algorithm.replay_bytes:
        return None
    replay_bytes = num_runs * algorithm.replay_bytes
    checkpoint_bytes = num_runs * num_bytes(algorithm.init, jax.random.PRNGKey(0))
    replay, disk = f"{replay_bytes / 1e9:,.2f} GB", f"{2 * checkpoint_bytes / 1e9:,.2f} GB"
    memory = device_memory()
    if replay_bytes > _USABLE * memory:
        fewer = " or train fewer seeds side by side (compare: together=1)" if num_runs > 1 else ""
        raise UserError(
            f"the replay needs {replay}, but the device has {memory / 1e9:,.2f} GB; lower algo.replay_capacity{fewer}"
        )
    existing = next(path for path in (run_dir.absolute(), *run_dir.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if 2 * checkpoint_bytes > free:
        raise UserError(
            f"checkpoints with their replay need {disk} of disk, but {existing} has {free / 1e9:,.2f} GB left; lower "
            "algo.replay_capacity or choose another run_dir"
        )
    return f"Replay: {replay} of device memory, and while a checkpoint replaces the one before up to {disk} of disk."
