"""Means, sums and maxima over the devices that learn together, inside a program; on one device nothing happens."""

from typing import Any

import jax

AXIS = "devices"


def axis() -> str | None:
    """The name of the axis over devices, in a program that has one."""
    try:
        jax.lax.axis_size(AXIS)
    except NameError:
        return None
    return AXIS


def mean(tree: Any) -> Any:
    """Means over the devices."""
    return jax.lax.pmean(tree, AXIS) if axis() else tree


def total(tree: Any) -> Any:
    """Sums over the devices."""
    return jax.lax.psum(tree, AXIS) if axis() else tree


def largest(tree: Any) -> Any:
    """Maxima over the devices."""
    return jax.lax.pmax(tree, AXIS) if axis() else tree
