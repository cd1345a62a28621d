"""Reductions over the devices that train one run together. Without an axis name they return their argument."""

from typing import TypeVar

import jax

__all__ = ["DEVICES", "largest", "mean", "total"]

_Tree = TypeVar("_Tree")

DEVICES = "devices"
"""Name of the mapped axis over devices."""


def mean(tree: _Tree, axis_name: str | None) -> _Tree:
    """Means over the devices."""
    return jax.lax.pmean(tree, axis_name) if axis_name else tree


def total(tree: _Tree, axis_name: str | None) -> _Tree:
    """Sums over the devices."""
    return jax.lax.psum(tree, axis_name) if axis_name else tree


def largest(tree: _Tree, axis_name: str | None) -> _Tree:
    """Maxima over the devices."""
    return jax.lax.pmax(tree, axis_name) if axis_name else tree
