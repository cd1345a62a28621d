"""Speed of one training on several GPUs of a host, next to its speed on one."""

import functools
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.experiments.recorded_time import read_device_time
from mjx_walk.experiments.timing import Measurement, training
from mjx_walk.logs.metrics import Row
from mjx_walk.settings.config import Config
from mjx_walk.training.call_profile import CALLS_BEFORE
from mjx_walk.utils.errors import UserError

__all__ = ["Speed", "measure", "measure_speed", "share_of_total"]

_MIN_CALLS = 3
_ENDLESS = 10**12


class Speed(NamedTuple):
    """Speed of a training."""

    steps_per_second: float
    """Environment steps of all devices."""
    call_seconds: float


def measure(overrides: list[str], config: Config, sizes: list[int], seconds: float) -> Iterator[Measurement]:
    """Measure each number of GPUs, first with the recipe's environments on each, then with the recipe's in total.

    The speeds come first, and then what the first device does in a call.

    Args:
        overrides: as for `train`.
        config: the same, composed.
        sizes: numbers of GPUs of this host.
        seconds: least time to measure each speed.

    Raises:
        UserError: training rejects these settings, or the environments or the batch are no multiple of a size.
        RuntimeError: training failed.
    """
    shares = {size: share_of_total(config, size) for size in sizes if size > 1}
    variants: list[tuple[str, int, list[str]]] = []
    for size in sizes:
        variants.append((f"{size} x {config.num_envs} environments", size, overrides))
        if size > 1:
            name = f"{size} x {config.num_envs // size} environments"
            variants.append((name, size, [*overrides, *shares[size]]))
    alone = None
    for name, size, arguments in variants:
        speed = measure_speed(arguments, size, seconds)
        alone = speed.steps_per_second if size == 1 else alone
        yield from _speeds(name, speed, alone if size > 1 else None)
    for name, size, arguments in variants:
        yield from _parts(name, arguments, size)


def share_of_total(config: Config, size: int) -> list[str]:
    """Settings with which `size` devices together have the environments, batch and replay of one.

    Raises:
        UserError: they cannot be divided.
    """
    totals = {"num_envs": config.num_envs}
    if isinstance(config.algo, OffPolicyConfig):
        totals |= {"algo.batch_size": config.algo.batch_size, "algo.replay_capacity": config.algo.replay_capacity}
    for name in ("num_envs", "algo.batch_size"):
        if totals.get(name, size) % size:
            raise UserError(f"{name}={totals[name]} cannot be divided evenly among {size} devices")
    return [f"{name}={total // size}" for name, total in totals.items()]


def measure_speed(overrides: list[str], size: int, seconds: float) -> Speed:
    """Train on `size` devices, with the overrides' environments on each, until enough calls are logged."""
    with _training(overrides, size, functools.partial(_are_enough, seconds)) as (rows, _):
        timed = _timed(rows)
    steps, time_taken = (timed[-1][name] - timed[0][name] for name in ("env_steps", "wall_seconds"))
    return Speed(steps / time_taken, time_taken / (len(timed) - 1))


def _training(
    overrides: list[str], size: int, are_enough: Callable[[list[Row]], bool]
) -> AbstractContextManager[tuple[list[Row], Path]]:
    """See `timing.training`."""
    return training([*overrides, f"total_steps={_ENDLESS}", f"devices={size}"], are_enough, signal.SIGTERM)


def _timed(rows: list[Row]) -> list[Row]:
    """The rows from the end of the last call that compiles."""
    return rows[CALLS_BEFORE - 1 :]


def _are_enough(seconds: float, rows: list[Row]) -> bool:
    """Whether the timed rows span enough calls and time."""
    timed = _timed(rows)
    return len(timed) > _MIN_CALLS and timed[-1]["wall_seconds"] - timed[0]["wall_seconds"] >= seconds


def _speeds(name: str, speed: Speed, alone: float | None) -> Iterator[Measurement]:
    yield Measurement(f"training, {name}", speed.steps_per_second, "env-steps/s")
    if alone:
        yield Measurement(f"  {name}: times one device", speed.steps_per_second / alone, "times")
    yield Measurement(f"  {name}: a call", speed.call_seconds * 1e3, "ms")


def _parts(name: str, overrides: list[str], size: int) -> Iterator[Measurement]:
    """Work of the first device in a call, from a training of its own: recording changes the speed.

    On GPUs, a process that records may crash or hang (jax 0.11, Warp 1.18). Its parts are then left out. Recording a
    second call hangs on one GPU, so only one is recorded.
    """
    num_rows = CALLS_BEFORE + 2  # the recording is written before the last of these calls
    try:
        with _training([*overrides, "profile_calls=1"], size, lambda rows: len(rows) >= num_rows) as (_, run_dir):
            recorded = read_device_time(run_dir / "profile")
    except RuntimeError as error:
        warnings.warn(f"{name}: the training that JAX's profiler recorded failed: {str(error)[-200:]}", stacklevel=2)
        return
    for part in ("physics", "reductions"):
        yield Measurement(f"  {name}: {part} in a recorded call", getattr(recorded, part) * 1e3, "ms")
    yield Measurement(f"  {name}: share of reductions", 100 * recorded.reductions / recorded.total, "%")
