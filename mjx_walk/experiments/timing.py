"""Short trainings as a user starts them, timed by the rows that they log."""

import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import STDOUT

from mjx_walk.runs.metrics import Row, read_rows
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.subprocesses import start_module

_ENDLESS = 10**15
_MIN_CHUNKS = 3


def first_chunk_times(overrides: list[str]) -> dict[str, float]:
    """Seconds from the trainer's start to the end of its first chunk, without and with what JAX and Warp cache.

    Each in a process of its own: Warp numbers its calls within a process, and the numbers are part of JAX's programs,
    so that a process never finds its own ones again.

    Raises:
        UserError: training refuses these settings.
        RuntimeError: it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        places = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/jax", "WARP_CACHE_PATH": f"{folder}/warp"}

        def one() -> float:
            # Killed before it has written a replay to the disk.
            return _rows_of([*overrides, "total_steps=1"], bool, signal.SIGKILL, places)[0]["wall_seconds"]

        return {"cold": one(), "warm": one()}


def speeds_by_devices(overrides: list[str], sizes: list[int], seconds: float) -> dict[int, float]:
    """Environment steps per second of one training on so many GPUs, each with `num_envs` copies.

    From the end of the second chunk on: in the first one programs are compiled, and those that look at its results are
    when it has ended.

    Args:
        overrides: as for `train`.
        sizes: numbers of GPUs of this host.
        seconds: to measure each for, at least.

    Raises:
        UserError: training refuses these settings.
        RuntimeError: it failed.
    """

    def are_enough(rows: list[Row]) -> bool:
        counted = rows[1:]
        return len(counted) > _MIN_CHUNKS and counted[-1]["wall_seconds"] - counted[0]["wall_seconds"] >= seconds

    speeds = {}
    for size in sizes:
        # Asked to stop, since it stops its processes then.
        rows = _rows_of([*overrides, f"total_steps={_ENDLESS}", f"devices={size}"], are_enough, signal.SIGTERM)
        steps, time_taken = (rows[-1][name] - rows[1][name] for name in ("env_steps", "wall_seconds"))
        speeds[size] = steps / time_taken
    return speeds


def _rows_of(
    arguments: list[str],
    are_enough: Callable[[list[Row]], bool],
    last_signal: signal.Signals,
    env: dict[str, str] | None = None,
) -> list[Row]:
    """Train until enough is logged."""
    with tempfile.TemporaryDirectory() as folder:
        run_dir, output = Path(folder, "run"), Path(folder, "output.txt")
        whole = [*arguments, "evaluation.gymnasium_episodes=0", f"run_dir={run_dir}"]
        with (
            output.open("w") as file,
            start_module("train", *whole, env=env, stdout=file, stderr=STDOUT) as process,
        ):
            try:
                # It lives on for a while after its last row, which is therefore seen.
                while not are_enough(rows := read_rows(run_dir / "metrics.jsonl")) and process.poll() is None:
                    time.sleep(0.1)
            finally:
                process.send_signal(last_signal)
        if are_enough(rows):
            return rows
        if process.returncode == 2:
            raise UserError(output.read_text().splitlines()[-1].removeprefix("error: "))
        raise RuntimeError(f"train {' '.join(whole)}: {output.read_text()}")
