"""Gymnasium's `info` dictionaries from arrays: of one environment, and with a mask for each entry of many."""

from collections.abc import Mapping

import jax
import numpy as np

from mjx_walk.envs import State

__all__ = ["FLAGS", "add_flags", "add_info", "on_host", "single_info"]

FLAGS = ("nonfinite", "overflow")
"""Metrics that `info` holds, as 1.0, only where they are set."""


def on_host(state: State, qpos: np.ndarray | None = None, qvel: np.ndarray | None = None) -> State:
    """A state in NumPy arrays, with physics and memory in float64, so that `info` is computed in float64.

    Args:
        state: of one environment.
        qpos: position before it was rounded to float32, `[nq] f64`.
        qvel: likewise for the velocity, `[nv] f64`.
    """
    state = jax.device_get(state)
    physics, memory = jax.tree.map(_with_double, (state.physics, state.memory))
    if qpos is not None and qvel is not None:
        physics = physics._replace(qpos=qpos, qvel=qvel)
    return state.replace(physics=physics, memory=memory)


def _with_double(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, np.float64) if array.dtype == np.float32 else array


def single_info(
    info: Mapping[str, jax.Array], metrics: Mapping[str, jax.Array] | None = None
) -> dict[str, np.ndarray | np.float64 | float]:
    """The `info` of one environment.

    Args:
        info: numbers, `[]`, or arrays, on the host.
        metrics: of a step; those of `FLAGS` are added where they are set.

    Returns:
        NumPy scalars and writable arrays in float64, and integers as `int`.
    """
    flags = {name: 1.0 for name in FLAGS if metrics is not None and metrics[name] > 0}
    return {name: _converted(value) for name, value in info.items()} | flags


def _converted(value: jax.Array) -> np.ndarray | np.float64 | int:
    array = np.asarray(value)
    if array.ndim:
        return np.array(array, np.float64)
    return int(array) if np.issubdtype(array.dtype, np.integer) else np.float64(array)


def add_info(target: dict[str, np.ndarray], info: Mapping[str, jax.Array | np.ndarray], mask: np.ndarray) -> None:
    """Add entries of some environments, as Gymnasium's `VectorEnv._add_info` adds those of one.

    Args:
        target: the `info` of all environments. It gets no entry if the mask is empty.
        info: `[B, …]` each.
        mask: which environments have the entries, `[B] bool`.
    """
    if not mask.any():
        return
    for name, value in info.items():
        value = np.asarray(value)
        dtype = np.int64 if np.issubdtype(value.dtype, np.integer) else np.float64
        target.setdefault(name, np.zeros(value.shape, dtype))[mask] = value[mask]
        target.setdefault(f"_{name}", np.zeros(mask.shape, np.bool_))[mask] = True


def add_flags(target: dict[str, np.ndarray], metrics: Mapping[str, jax.Array], mask: np.ndarray) -> None:
    """Add the metrics of `FLAGS` for the environments of a mask, `[B] bool`, in which they are set."""
    for name in FLAGS:
        add_info(target, {name: metrics[name]}, mask & (np.asarray(metrics[name]) > 0))
