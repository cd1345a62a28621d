"""Means and sums over the devices that learn together, inside a program; where there is one device, nothing happens."""

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
