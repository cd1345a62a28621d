"""Device time of recorded program calls, read from a recording of JAX's profiler."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jax.profiler import ProfileData, ProfileEvent

__all__ = ["DeviceTime", "read_device_time"]

_REDUCTION = re.compile(r"nccl|(psum|pmax|all[-_](reduce|gather))[-.\w]*$", re.IGNORECASE)
"""NCCL's kernels on a GPU, XLA's operations on a CPU."""
_PHYSICS = re.compile(r"_cuda_kernel_forward")
"""Warp's kernels."""


class DeviceTime(NamedTuple):
    """Seconds on one device. Parts that run at the same time count in full."""

    total: float
    """From the start of the first operation to the end of the last one."""
    reductions: float
    """Reductions over devices, with the time in which they wait for other devices."""
    physics: float
    """Warp's kernels."""


def read_device_time(folder: Path) -> DeviceTime:
    """Sum the times of the newest recording of one process.

    Args:
        folder: where `jax.profiler.start_trace` wrote.

    Raises:
        FileNotFoundError: no recording.
    """
    recordings = sorted(folder.rglob("*.xplane.pb"))
    if not recordings:
        raise FileNotFoundError(f"no recording of JAX's profiler in {folder}")
    events = list(_operations(ProfileData.from_file(str(recordings[-1]))))
    total = max(event.end_ns for event in events) - min(event.start_ns for event in events)
    return DeviceTime(total * 1e-9, *(_seconds(events, pattern) for pattern in (_REDUCTION, _PHYSICS)))


def _seconds(events: list[ProfileEvent], pattern: re.Pattern) -> float:
    return sum(event.duration_ns for event in events if pattern.search(event.name)) * 1e-9


def _operations(recorded: ProfileData) -> Iterator[ProfileEvent]:
    """Kernels and copies of a GPU, or what XLA's threads run on a CPU."""
    planes = list(recorded.planes)
    on_gpu = [line for plane in planes if plane.name.startswith("/device:GPU") for line in plane.lines]
    on_cpu = [line for plane in planes for line in plane.lines if "XLA" in line.name]
    for line in [line for line in on_gpu if line.name.startswith("Stream")] or on_cpu:
        yield from line.events
