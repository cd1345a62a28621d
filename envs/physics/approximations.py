"""Differences between the MJX engines and MuJoCo's C library, and slow compilation, of which the user is warned."""

import logging
from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Int

from mjx_walk.envs.physics.elements import pairs_that_move

__all__ = ["warn_of_approximations"]

_LOGGER = logging.getLogger(__name__)

_Geom = mujoco.mjtGeom
_AS_IN_MUJOCO = {
    *((_Geom.mjGEOM_PLANE, other) for other in (_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_CAPSULE)),
    (_Geom.mjGEOM_PLANE, _Geom.mjGEOM_ELLIPSOID),
    *((_Geom.mjGEOM_SPHERE, other) for other in (_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_BOX)),
    *((_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_MESH), (_Geom.mjGEOM_HFIELD, _Geom.mjGEOM_SPHERE)),
    (_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_CAPSULE),
}
"""Pairs of geoms whose contacts the `jax` engine finds as MuJoCo does. For others it finds other points.

Errors of velocities after a physics step, in 48 states of one falling body on one fixed geom, relative to one plus
their change (90% of the states, largest): plane and mesh 2.7e-2, 2.0e-1; capsule and mesh 6.7e-2, 1.8e-1; box and mesh
1.5e-2, 2.0e-1; two meshes 2.4e-2, 8.3e-2; sphere and mesh 1.5e-5, 6.6e-5. On a height field: sphere 6.9e-7, 1.2e-3;
capsule 3.6e-3, 5.5e-2; box 1.8e-1, 4.9e-1; mesh 1.5e-1, 2.9e-1."""
_NOT_ON_WARP = {
    *((_Geom.mjGEOM_HFIELD, other) for other in (_Geom.mjGEOM_BOX, _Geom.mjGEOM_CYLINDER)),
    *((_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_ELLIPSOID), (_Geom.mjGEOM_ELLIPSOID, _Geom.mjGEOM_ELLIPSOID)),
    *(
        (round_one, other)
        for round_one in (_Geom.mjGEOM_ELLIPSOID, _Geom.mjGEOM_CYLINDER)
        for other in (_Geom.mjGEOM_CYLINDER, _Geom.mjGEOM_BOX, _Geom.mjGEOM_MESH)
    ),
}
"""Pairs of geoms whose contacts the `warp` engine finds at other points than MuJoCo.

The same errors on a height field: box 3.1e-3, 6.3; cylinder 2.6e-3, 2.7e-2; capsule 1.2e-4, 3.9e-3; mesh 1.2e-3,
1.3e-2. In 128 states of a depth of 2 mm, and as many of 10 mm, the larger of both (`tests/contact_kinds.py`): capsule
and ellipsoid 4.5e-4, 0.39; ellipsoid and others 3.5e-3, 6.8e-2; cylinder and cylinder 1.0e-3, 5.0e-3, box 9.3e-4, 1.2,
mesh 1.0e-3, 1.1e-2. Not warned of: sphere and ellipsoid 2.5e-4, 4.5e-4; capsule and cylinder 3.6e-4, 1.8e-3. All
others have at most 8.1e-5."""

_MANY_VERTICES = 64
"""On two busy cores, MJX's step of Spot compiled in 4 minutes with at most 32 vertices a mesh. With the own hulls
of the file, of up to 216, it had not compiled after 12 minutes."""


def warn_of_approximations(model: mujoco.MjModel, engine: str, enough_iterations: int) -> None:
    """Log a warning for what an MJX engine simulates otherwise than MuJoCo's C library, or compiles slowly.

    Args:
        model: the model as loaded.
        engine: `warp` or `jax`.
        enough_iterations: iterations of the constraint solver that suffice to converge.
    """
    fewest = min(model.opt.iterations, model.opt.ls_iterations)
    if fewest < enough_iterations:
        _LOGGER.warning(
            "the model stops the constraint solver after %d iterations; physics=%s lets it converge, unlike physics=c",
            fewest,
            engine,
        )
    pair = next(_other_contacts(model, engine), None)
    if pair:
        _LOGGER.warning(
            "physics=%s finds other contact points than MuJoCo between %s and %s; physics=%s is closer",
            engine,
            *(
                f"{_kind(model, geom).name.removeprefix('mjGEOM_').lower()} '{model.geom(geom).name or geom}'"
                for geom in pair
            ),
            "warp or c" if engine == "jax" else "c",
        )
    mesh = next(_detailed_meshes(model), None) if engine == "jax" else None
    if mesh is not None:
        _LOGGER.warning(
            "physics=jax compiles slowly for mesh '%s' with %d vertices; set its maxhullvert=\"32\", or physics=warp",
            model.mesh(mesh).name or mesh,
            _hull_vertices(model, mesh),
        )


def _detailed_meshes(model: mujoco.MjModel) -> Iterator[int]:
    """Meshes with many vertices that may touch another mesh."""
    geoms, _ = pairs_that_move(model)
    touching = geoms[(model.geom_type[geoms] == _Geom.mjGEOM_MESH).all(axis=1)]
    for mesh in map(int, np.unique(model.geom_dataid[touching])):
        if _hull_vertices(model, mesh) > _MANY_VERTICES:
            yield mesh


def _hull_vertices(model: mujoco.MjModel, mesh: int) -> int:
    """Vertices of a mesh's convex hull, which MuJoCo computes for meshes that may touch something."""
    address = model.mesh_graphadr[mesh]
    return int(model.mesh_graph[address]) if address >= 0 else 0


def _other_contacts(model: mujoco.MjModel, engine: str) -> Iterator[tuple[int, int]]:
    """Pairs of geoms whose contacts an MJX engine finds at other points than MuJoCo."""
    geoms, _ = pairs_that_move(model)
    for first, second in geoms.tolist():
        kinds = _kind(model, first), _kind(model, second)
        if kinds not in _AS_IN_MUJOCO if engine == "jax" else kinds in _NOT_ON_WARP:
            yield first, second
    if engine == "jax":
        yield from _parallel_capsules(model, geoms)


def _kind(model: mujoco.MjModel, geom: int) -> mujoco.mjtGeom:
    return mujoco.mjtGeom(model.geom_type[geom])


def _parallel_capsules(model: mujoco.MjModel, geoms: Int[np.ndarray, "n 2"]) -> Iterator[tuple[int, int]]:
    """Pairs of capsules that are parallel in every pose. MuJoCo gives them two contacts, `jax` one."""
    geoms = geoms[(model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_CAPSULE).all(axis=1)]
    if not geoms.size:
        return
    data = mujoco.MjData(model)
    is_parallel = np.ones(len(geoms), bool)
    for speed in (0.0, 1.0, 2.0):
        mujoco.mj_integratePos(model, data.qpos, speed * np.sin(1.0 + np.arange(model.nv)), 1.0)
        mujoco.mj_kinematics(model, data)
        axes = data.geom_xmat.reshape(-1, 3, 3)[geoms, :, 2]
        is_parallel &= np.linalg.norm(np.cross(axes[:, 0], axes[:, 1]), axis=1) < 1e-6
    for first, second in geoms[is_parallel]:
        yield int(first), int(second)
