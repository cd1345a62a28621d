"""Speed of complete trainings, each started in a child process as a user starts it and timed by the rows it logs."""

import functools
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import STDOUT
from typing import NamedTuple

from mjx_walk.runs.metrics import Row, read_rows
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.subprocesses import start_module

_ENDLESS = 10**12
_MIN_CALLS = 3


class Measurement(NamedTuple):
    """One measured quantity."""

    name: str
    value: float
    unit: str


def measure(overrides: list[str], sizes: list[int], seconds: float) -> Iterator[Measurement]:
    """Measure the first call of a training with cold and warm caches, and its speed on several numbers of GPUs.

    Args:
        overrides: as for `train`.
        sizes: numbers of GPUs of this host; the first is 1.
        seconds: least time to measure each speed.

    Raises:
        UserError: training rejects these settings.
        RuntimeError: training failed.
    """
    for name, value in first_call_times(overrides).items():
        yield Measurement(f"compile and first call, {name} caches", value, "s")
    speeds = speeds_by_devices(overrides, sizes, seconds)
    for size, speed in speeds.items():
        yield Measurement(f"training on {size} {'device' if size == 1 else 'devices'}", speed, "env-steps/s")
        if size > 1:
            yield Measurement(f"  speedup over 1 device, of {size}", speed / speeds[1], "times")


def first_call_times(overrides: list[str]) -> dict[str, float]:
    """Seconds from the trainer's start to the end of its first call, with `cold` and with `warm` caches.

    Each run has its own process. Warp numbers its calls within a process, and JAX's programs contain these numbers, so
    a process never finds its own programs in JAX's cache.
    """
    times = {}
    with tempfile.TemporaryDirectory() as folder:
        caches = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/jax", "WARP_CACHE_PATH": f"{folder}/warp"}
        for name in ("cold", "warm"):
            # SIGKILL ends it before it writes a replay to the disk.
            rows = _rows_of([*overrides, "total_steps=1"], bool, signal.SIGKILL, caches)
            times[name] = rows[0]["wall_seconds"]
    return times


def speeds_by_devices(overrides: list[str], sizes: list[int], seconds: float) -> dict[int, float]:
    """Environment steps per second of one training on each number of GPUs, with `num_envs` environments per GPU.

    The clock starts at the end of the second call: the first call compiles the training's programs, and the programs
    that read its results compile after it.
    """
    speeds = {}
    for size in sizes:
        arguments = [*overrides, f"total_steps={_ENDLESS}", f"devices={size}"]
        # At SIGTERM it also stops its own child processes.
        rows = _rows_of(arguments, functools.partial(_are_enough, seconds), signal.SIGTERM)
        steps, time_taken = (rows[-1][name] - rows[1][name] for name in ("env_steps", "wall_seconds"))
        speeds[size] = steps / time_taken
    return speeds


def _are_enough(seconds: float, rows: list[Row]) -> bool:
    """Whether the rows after the first one span enough calls and time."""
    counted = rows[1:]
    return len(counted) > _MIN_CALLS and counted[-1]["wall_seconds"] - counted[0]["wall_seconds"] >= seconds


def _rows_of(
    overrides: list[str],
    are_enough: Callable[[list[Row]], bool],
    last_signal: signal.Signals,
    env: dict[str, str] | None = None,
) -> list[Row]:
    """Train until enough rows are logged, then send the signal."""
    with tempfile.TemporaryDirectory() as folder:
        run_dir, output = Path(folder, "run"), Path(folder, "output.txt")
        arguments = [*overrides, "evaluation.gymnasium_episodes=0", f"run_dir={run_dir}"]
        with (
            output.open("w") as file,
            start_module("train", *arguments, env=env, stdout=file, stderr=STDOUT) as process,
        ):
            try:
                # The process outlives its last row for a while, so this loop reads that row.
                while not are_enough(rows := read_rows(run_dir / "metrics.jsonl")) and process.poll() is None:
                    time.sleep(0.1)
            finally:
                process.send_signal(last_signal)
        if are_enough(rows):
            return rows
        if process.returncode == 2:
            raise UserError(output.read_text().splitlines()[-1].removeprefix("error: "))
        raise RuntimeError(f"train {' '.join(arguments)}: {output.read_text()}")
