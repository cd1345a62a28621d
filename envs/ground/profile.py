"""Profile of the hills along x: sections in which the height is a straight line."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_walk.envs.ground.options import Ground
from mjx_walk.utils.errors import UserError

__all__ = ["FOOT", "ROW_LENGTH", "Section", "sections"]

ROW_LENGTH = 9.0
"""m."""
FOOT = 3.0
"""Length of the flat foot of a hill, on which a humanoid can lie, m."""
_STEP_DEPTH = 0.4
"""Length of a step, or of a bar, m."""
_NUM_STEPS = 6
"""Steps up to the top of a hill. A ramp is as long as they are."""


class Section(NamedTuple):
    """A part of the way that is raised."""

    start: float
    """Where it starts, m."""
    end: float
    """Where it ends, m."""
    first: float
    """Height at the start, m."""
    last: float
    """Height at the end, m."""


def sections(ground: Ground) -> list[Section]:
    """The raised parts of a ground that is not flat, in ascending order. The first row starts at x = 0.

    Kinds of hills take turns. The last hill of each kind has the full height.

    Raises:
        UserError: there are fewer rows than kinds.
    """
    kinds = [
        kind
        for kind, size in ((_ramps, ground.slope), (_steps, ground.step_height), (_bars, ground.roughness))
        if size > 0
    ]
    if ground.rows < len(kinds):
        raise UserError(f"env.ground.rows={ground.rows} leaves no room for {len(kinds)} kinds of hills; give more rows")
    found: list[Section] = []
    for row in range(ground.rows):
        same_kind = range(row % len(kinds), ground.rows, len(kinds))
        hill = kinds[row % len(kinds)](ground, (same_kind.index(row) + 1) / len(same_kind), row)
        start = ROW_LENGTH * row + FOOT
        found += [part._replace(start=part.start + start, end=part.end + start) for part in hill]
    return found


def _ramps(ground: Ground, difficulty: float, row: int) -> Iterator[Section]:
    """A ramp up, a top and a ramp down."""
    climb, length = _STEP_DEPTH * _NUM_STEPS, ROW_LENGTH - FOOT
    height = climb * math.tan(math.radians(ground.slope) * difficulty)
    yield Section(0.0, climb, 0.0, height)
    yield Section(climb, length - climb, height, height)
    yield Section(length - climb, length, height, 0.0)


def _steps(ground: Ground, difficulty: float, row: int) -> Iterator[Section]:
    """Steps up, a top and steps down."""
    up = np.arange(_NUM_STEPS) * _STEP_DEPTH
    down = ROW_LENGTH - FOOT - up[::-1]
    edges = np.concatenate([up, down])
    counts = [*range(1, _NUM_STEPS + 1), *range(_NUM_STEPS - 1, 0, -1)]
    for start, end, count in zip(edges[:-1], edges[1:], counts, strict=True):
        height = ground.step_height * difficulty * count
        yield Section(float(start), float(end), height, height)


def _bars(ground: Ground, difficulty: float, row: int) -> Iterator[Section]:
    """Bars across the way, of random heights, which are the same in every run."""
    starts = np.arange(0.0, ROW_LENGTH - FOOT - _STEP_DEPTH / 2, _STEP_DEPTH)
    sizes: Float[np.ndarray, " bars"] = np.random.default_rng(row).uniform(size=len(starts))
    for start, size in zip(starts, sizes, strict=True):
        height = ground.roughness * difficulty * size
        yield Section(float(start), float(start) + _STEP_DEPTH, height, height)
