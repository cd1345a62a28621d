"""Reductions over the devices that train one run together. Without an axis name they return their argument."""

from typing import Any

import jax

DEVICES = "devices"
"""Name of the mapped axis over devices."""


def mean(tree: Any, axis_name: str | None) -> Any:
    """Means over the devices."""
    return jax.lax.pmean(tree, axis_name) if axis_name else tree


def total(tree: Any, axis_name: str | None) -> Any:
    """Sums over the devices."""
    return jax.lax.psum(tree, axis_name) if axis_name else tree


def largest(tree: Any, axis_name: str | None) -> Any:
    """Maxima over the devices."""
    return jax.lax.pmax(tree, axis_name) if axis_name else tree
