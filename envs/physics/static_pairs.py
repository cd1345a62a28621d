"""Pairs of geoms that may touch, without those that cannot move, which MuJoCo's C library drops. MJX simulates some.

A body cannot move if it is welded to the world or to a mocap body. Such contacts have no degree of freedom, and MJX's
solver divides by their zero inertia. MJX's JAX implementation keeps all of them, MuJoCo Warp those of `<pair>`.
"""

import itertools
from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Bool
from mujoco import mjx
from mujoco.mjx._src import collision_driver

__all__ = ["drop_static_pairs", "install", "moving_pairs"]

_NEVER = -1e10
"""Margin of a pair that is never in contact, m."""
_UPSTREAM = collision_driver.geom_pairs
_READ_BY_UPSTREAM = (
    *("pair_geom1", "pair_geom2", "exclude_signature", "geom_type", "geom_contype", "geom_conaffinity", "geom_bodyid"),
    *("body_geomadr", "body_geomnum", "body_weldid", "body_parentid", "body_dofnum"),
)
"""Arrays that the pairs depend on."""
_MAX_KNOWN = 4
_known: dict[tuple[bytes | int, ...], list[tuple[int, int, int]]] = {}
"""The pairs of the last models, by what they depend on. MJX asks several times, and many bodies take seconds."""


def _is_static_pair(model: mujoco.MjModel | mjx.Model, geom1: np.ndarray, geom2: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Whether neither geom of a pair can move."""
    bodies = [np.asarray(model.body_weldid)[np.asarray(model.geom_bodyid)[geom]] for geom in (geom1, geom2)]
    dofs = [np.asarray(model.body_dofnum)[body] for body in bodies]
    return (dofs[0] == 0) & (dofs[1] == 0)


def drop_static_pairs(model: mujoco.MjModel) -> None:
    """Change the margin of each `<pair>` that cannot move, so that it is never in contact."""
    model.pair_margin[_is_static_pair(model, model.pair_geom1, model.pair_geom2)] = _NEVER


def moving_pairs(model: mujoco.MjModel | mjx.Model) -> Iterator[tuple[int, int, int]]:
    """MJX's `geom_pairs` without the pairs that cannot move: both geoms, and the index of their `<pair>`, or -1."""
    arrays = (np.asarray(getattr(model, name), np.int32).tobytes() for name in _READ_BY_UPSTREAM)
    key = (int(model.opt.disableflags) & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT, *arrays)
    found = _known.get(key)
    if found is None:
        pairs = [*_UPSTREAM(model)]
        geom1, geom2, _ = np.array(pairs, int).reshape(-1, 3).T
        found = [*itertools.compress(pairs, ~_is_static_pair(model, geom1, geom2))]
        if len(_known) >= _MAX_KNOWN:
            _known.clear()
        _known[key] = found
    return iter(found)


def install() -> None:
    """Make MJX's JAX implementation drop these pairs."""
    collision_driver.geom_pairs = moving_pairs
