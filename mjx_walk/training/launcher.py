"""`devices=N`: start one process for each GPU of this host. They train one run together."""

import logging
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

from mjx_walk.machine.devices import count_devices, only_device
from mjx_walk.machine.signals import Interrupt, exit_code
from mjx_walk.machine.subprocesses import start_module
from mjx_walk.utils.errors import UserError

__all__ = ["count", "run"]

_LOGGER = logging.getLogger(__name__)

_PATIENCE = 20.0
"""Seconds that the other processes have to exit after one has failed."""


def count(asked: int | str) -> int:
    """Number of processes for `devices=N` or `devices=all`.

    Raises:
        UserError: the value is not valid, or this host has fewer GPUs.
    """
    hardware, available = count_devices()
    if asked == "all":
        return available
    if not isinstance(asked, int) or asked < 1:
        raise UserError(f"devices={asked} is not valid; use devices=all or an integer of at least 1")
    if hardware == "gpu" and asked > available:
        raise UserError(f"devices={asked} is more than the GPUs of this host ({available}); use devices=all")
    return asked


def run(arguments: list[str], size: int) -> int:
    """Train in `size` processes. Shows the output of the main process. Forwards Ctrl-C and SIGTERM to all.

    Returns:
        The exit code: the signal's after a signal, 2 after invalid input, 1 if a process failed.
    """
    with tempfile.TemporaryDirectory() as logs, Interrupt("all devices finish this call, then save") as interrupt:
        processes = _start(arguments, size, Path(logs))
        is_forwarded = False
        bad: list[int] = []
        while any(process.poll() is None for process in processes) and not bad:
            if interrupt.signal_name and not is_forwarded:
                is_forwarded = True
                for process in processes:
                    process.send_signal(signal.Signals[interrupt.signal_name])
            time.sleep(0.2)
            bad = [rank for rank, process in enumerate(processes) if process.poll()]
        _end(processes)
        if not bad:
            return 0
        rank = min(bad, key=lambda rank: (processes[rank].returncode > 0, rank))  # killed ones first
        code = processes[rank].returncode
        if interrupt.signal_name:
            return exit_code(interrupt.signal_name)
        if rank:
            output = _log_file(Path(logs), rank).read_text(encoding="utf-8", errors="replace")
            _LOGGER.error(f"the output of device {rank} ends with:\n{output[-2000:]}")
        if code != 2:  # with code 2 the process has printed its own error
            _LOGGER.error(
                f"the process of device {rank} failed with exit code {code}; "
                "the last saved checkpoint is complete; add resume=true to resume from it"
            )
        return 2 if code == 2 else 1


def _start(arguments: list[str], size: int, logs: Path) -> list[subprocess.Popen]:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        coordinator = f"localhost:{free.getsockname()[1]}"
    processes = []
    for rank in range(size):
        env = {"MJX_WALK_PROCESS": f"{rank},{size},{coordinator}"} | only_device(rank)
        with _log_file(logs, rank).open("wb") as log:
            output = log if rank else None
            processes.append(start_module("train", *arguments, env=env, stdout=output, stderr=output))
    return processes


def _log_file(logs: Path, rank: int) -> Path:
    return logs / f"{rank}.txt"


def _end(processes: list[subprocess.Popen]) -> None:
    """Wait `_PATIENCE` seconds for the remaining processes, then kill them. They may block on the failed process."""
    deadline = time.monotonic() + _PATIENCE
    while time.monotonic() < deadline and any(process.poll() is None for process in processes):
        time.sleep(0.2)
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.wait()
