"""Contacts between bodies that cannot move, which MuJoCo's C library drops. MJX simulates some of them.

A body cannot move if it is welded to the world or to a mocap body. Such contacts have no degree of freedom, and MJX's
solver divides by their zero inertia. MJX's JAX implementation keeps all of them, MuJoCo Warp those of `<pair>`.
"""

import functools
import itertools
from collections.abc import Callable, Iterator

import mujoco
import numpy as np
from jaxtyping import Bool
from mujoco import mjx
from mujoco.mjx._src import collision_driver

__all__ = ["drop_static_pairs", "install"]

_NEVER = -1e10
"""Margin of a pair that is never in contact, m."""


def _is_static_pair(model: mujoco.MjModel | mjx.Model, geom1: np.ndarray, geom2: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Whether neither geom of a pair can move."""
    bodies = [np.asarray(model.body_weldid)[np.asarray(model.geom_bodyid)[geom]] for geom in (geom1, geom2)]
    dofs = [np.asarray(model.body_dofnum)[body] for body in bodies]
    return (dofs[0] == 0) & (dofs[1] == 0)


def drop_static_pairs(model: mujoco.MjModel) -> None:
    """Change the margin of each `<pair>` that cannot move, so that it is never in contact."""
    model.pair_margin[_is_static_pair(model, model.pair_geom1, model.pair_geom2)] = _NEVER


def _moving_pairs(
    geom_pairs: Callable[[mujoco.MjModel | mjx.Model], Iterator[tuple[int, int, int]]],
) -> Callable[[mujoco.MjModel | mjx.Model], Iterator[tuple[int, int, int]]]:
    """MJX's `geom_pairs` without the pairs that cannot move."""

    @functools.wraps(geom_pairs)
    def moving_pairs(model: mujoco.MjModel | mjx.Model) -> Iterator[tuple[int, int, int]]:
        pairs = [*geom_pairs(model)]
        geom1, geom2, _ = np.array(pairs, int).reshape(-1, 3).T
        yield from itertools.compress(pairs, ~_is_static_pair(model, geom1, geom2))

    return moving_pairs


_UPSTREAM = collision_driver.geom_pairs


def install() -> None:
    """Make MJX's JAX implementation drop these pairs."""
    collision_driver.geom_pairs = _moving_pairs(_UPSTREAM)
