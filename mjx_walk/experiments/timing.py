"""Complete trainings, each started in a child process as a user starts it and timed by the rows it logs."""

import contextlib
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import STDOUT, Popen, TimeoutExpired
from typing import NamedTuple

from mjx_walk.logs.metrics import Row, read_rows
from mjx_walk.machine.signals import as_by_ctrl_c
from mjx_walk.machine.subprocesses import start_module, with_parent
from mjx_walk.utils.errors import UserError

__all__ = ["Measurement", "measure_first_calls", "training"]

_PATIENCE = 60.0
"""Seconds: a training hangs if it logs no row for at least this long, and is killed if it takes longer to end."""


class Measurement(NamedTuple):
    """One measured quantity."""

    name: str
    value: float
    unit: str


def measure_first_calls(overrides: list[str]) -> Iterator[Measurement]:
    """Measure from the trainer's start to the end of its first call, with cold and with warm caches.

    Each run has its own process. Warp numbers its calls within a process, and JAX's programs contain these numbers, so
    a process never finds its own programs in JAX's cache.

    Args:
        overrides: as for `train`.

    Raises:
        UserError: training rejects these settings.
        RuntimeError: training failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        caches = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/jax", "WARP_CACHE_PATH": f"{folder}/warp"}
        for name in ("cold", "warm"):
            # SIGKILL ends it before it writes a replay to the disk.
            with training([*overrides, "total_steps=1"], bool, signal.SIGKILL, caches) as (rows, _):
                yield Measurement(f"compile and first call, {name} caches", rows[0]["wall_seconds"], "s")


@contextlib.contextmanager
def training(
    overrides: list[str],
    are_enough: Callable[[list[Row]], bool],
    last_signal: signal.Signals,
    env: dict[str, str] | None = None,
) -> Iterator[tuple[list[Row], Path]]:
    """Train until enough rows are logged, then send the signal. Gives the rows and the run folder, which is removed.

    The training ends with this process.

    Args:
        overrides: as for `train`.
        are_enough: `rows → bool`.
        last_signal: how to end the training. At SIGTERM it also stops its own child processes.
        env: environment variables to add.

    Raises:
        UserError: training rejects these settings.
        RuntimeError: training failed, or hangs: no row came for three times as long as the first one took.
    """
    with as_by_ctrl_c(), tempfile.TemporaryDirectory() as folder:
        run_dir, output = Path(folder, "run"), Path(folder, "output.txt")
        arguments = [*overrides, "evaluation.gymnasium_episodes=0", f"run_dir={run_dir}"]
        with (
            output.open("wb") as file,
            start_module("train", *arguments, env=with_parent() | (env or {}), stdout=file, stderr=STDOUT) as process,
        ):
            hangs = False
            try:
                rows, hangs = _wait_for_rows(run_dir / "metrics.jsonl", are_enough, process)
            finally:
                _end(process, signal.SIGKILL if hangs else last_signal)
        if are_enough(rows):
            yield rows, run_dir
            return
        printed = output.read_text(encoding="utf-8", errors="replace")
        if process.returncode == 2:
            raise UserError(printed.splitlines()[-1].removeprefix("error: "))
        end = f"no row for {_limit(rows):.0f} s" if hangs else f"exit code {process.returncode}"
        raise RuntimeError(f"train {' '.join(arguments)}: {printed}{end}")


def _wait_for_rows(metrics: Path, are_enough: Callable[[list[Row]], bool], process: Popen) -> tuple[list[Row], bool]:
    """The rows once they are enough or the process has ended or hangs, and whether it hangs."""
    rows: list[Row] = []
    last_row_at = time.monotonic()
    # The process outlives its last row for a while, so this loop reads that row.
    while not are_enough(logged := read_rows(metrics)) and process.poll() is None:
        if len(logged) > len(rows):
            rows, last_row_at = logged, time.monotonic()
        if rows and time.monotonic() - last_row_at > _limit(rows):
            return rows, True
        time.sleep(0.1)
    return logged, False


def _end(process: Popen, last_signal: signal.Signals) -> None:
    process.send_signal(last_signal)
    try:
        with contextlib.suppress(TimeoutExpired):
            process.wait(_PATIENCE)
    finally:
        process.kill()


def _limit(rows: list[Row]) -> float:
    """Longest time in seconds between two rows. Only the first call compiles, so no other takes longer than it."""
    return max(_PATIENCE, 3 * rows[0]["wall_seconds"])
