"""Lowest points of geoms, from positions and orientations alone, so that every engine gives the same ones."""

from typing import NamedTuple, TypeVar

import mujoco
import numpy as np
from jax import Array
from jaxtyping import Float, Int

__all__ = ["Surface", "heights", "places", "surface", "touching_geoms"]

_GEOM = mujoco.mjtGeom
_NUM_DIRECTIONS = 48
"""Extreme points that stand for a mesh or an ellipsoid."""
_NUM_CORNERS = 12
"""Points of each rim of a cylinder."""
_Array = TypeVar("_Array", np.ndarray, Array)


class Surface(NamedTuple):
    """Points of some geoms, each the center of a sphere that the geom contains."""

    geoms: Int[np.ndarray, " points"]
    """The geom of each point."""
    points: Float[np.ndarray, "points 3"]
    """In the frame of the geom, m."""
    radii: Float[np.ndarray, " points"]
    """Radius of the sphere around each point, m."""


def surface(model: mujoco.MjModel, geoms: Int[np.ndarray, " geoms"]) -> Surface:
    """Points from which the lowest point of some geoms is computed. Planes and height fields have none."""
    parts = [(geom, *_points_of(model, int(geom))) for geom in geoms]
    parts = [(geom, points, radius) for geom, points, radius in parts if len(points)]
    return Surface(
        np.concatenate([np.zeros(0, np.int32), *(np.full(len(points), geom) for geom, points, _ in parts)]).astype(int),
        np.concatenate([np.zeros((0, 3)), *(points for _, points, _ in parts)]),
        np.concatenate([np.zeros(0), *(np.full(len(points), radius) for _, points, radius in parts)]),
    )


def heights(
    surface: Surface, geom_xpos: Float[_Array, "geoms 3"], geom_xmat: Float[_Array, "geoms 9"]
) -> Float[_Array, " points"]:
    """Lowest z of the sphere around each point, m.

    Args:
        surface: the points.
        geom_xpos: positions of all geoms, m.
        geom_xmat: orientations of all geoms, as `mjData` has them.
    """
    rows = geom_xmat[surface.geoms, 6:9]
    return geom_xpos[surface.geoms, 2] + (rows * surface.points).sum(-1) - surface.radii


def places(
    surface: Surface, geom_xpos: Float[_Array, "geoms 3"], geom_xmat: Float[_Array, "geoms 9"]
) -> tuple[Float[_Array, " points"], Float[_Array, " points"]]:
    """x and y of each point in the world, m. The arguments are those of `heights`."""
    x, y = (
        geom_xpos[surface.geoms, axis] + (geom_xmat[surface.geoms, 3 * axis : 3 * axis + 3] * surface.points).sum(-1)
        for axis in (0, 1)
    )
    return x, y


def touching_geoms(
    surface: Surface, data: mujoco.MjData, floor: float, tolerance: float
) -> Int[np.ndarray, " touching"]:
    """Ascending indices of the geoms of a surface that are at most `tolerance` above the floor, m."""
    found = heights(surface, data.geom_xpos, data.geom_xmat)
    return np.unique(surface.geoms[found <= floor + tolerance])


def _points_of(model: mujoco.MjModel, geom: int) -> tuple[Float[np.ndarray, "points 3"], float]:
    """Points of one geom in its frame, and the radius of the spheres around them."""
    kind, (a, b, c) = _GEOM(model.geom_type[geom]), model.geom_size[geom]
    if kind == _GEOM.mjGEOM_SPHERE:
        return np.zeros((1, 3)), float(a)
    if kind == _GEOM.mjGEOM_CAPSULE:
        return np.array([[0, 0, -b], [0, 0, b]]), float(a)
    if kind == _GEOM.mjGEOM_BOX:
        return np.array([a, b, c]) * _signs(), 0.0
    if kind == _GEOM.mjGEOM_CYLINDER:
        angles = np.linspace(0, 2 * np.pi, _NUM_CORNERS, endpoint=False)
        rim = np.stack([a * np.cos(angles), a * np.sin(angles), np.zeros_like(angles)], axis=1)
        end = np.array([0.0, 0.0, b])
        return np.concatenate([rim - end, rim + end]), 0.0
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        scaled = _directions() * [a, b, c]
        return scaled * [a, b, c] / np.linalg.norm(scaled, axis=1, keepdims=True), 0.0
    if kind == _GEOM.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
        return vertices[np.unique((vertices @ _directions().T).argmax(axis=0))].astype(float), 0.0
    return np.zeros((0, 3)), 0.0


def _signs() -> Float[np.ndarray, "8 3"]:
    """Corners of a cube."""
    return np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)


def _directions() -> Float[np.ndarray, "directions 3"]:
    """Unit vectors in all directions: a Fibonacci lattice, and the axes."""
    index = np.arange(_NUM_DIRECTIONS) + 0.5
    z, angle = 1 - 2 * index / _NUM_DIRECTIONS, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z**2)
    lattice = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return np.concatenate([lattice, np.eye(3), -np.eye(3)])
