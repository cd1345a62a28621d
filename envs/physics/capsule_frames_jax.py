"""MJX's contact frames of capsules on a plane, put right: the first tangent follows the capsule, as in C.

MJX 3.17 takes a default tangent where the capsule stands within 30° of the plane's normal, because it tests the axis'
length after projecting it. With a pyramidal cone the tangent decides how friction is shared out.
"""

import jax
import jax.numpy as jnp
from mujoco.mjx._src import collision_driver, collision_primitive
from mujoco.mjx._src.collision_types import Collision
from mujoco.mjx._src.types import Data, GeomType, Model

_MIN_NORM = 1e-15


def plane_capsule(model: Model, data: Data, key: object, geom: jax.Array) -> Collision:
    """MJX's collision function for planes and capsules, with C's frames.

    Source: `mjraw_PlaneCapsule` and `mju_makeFrame` of MuJoCo.

    Args:
        model: the model.
        data: with the geoms' poses.
        key: unused.
        geom: `[N, 2] i32`, plane and capsule of each pair.

    Returns:
        Distances `[2N]`, positions `[2N, 3]` and frames `[2N, 3, 3]` of the capsules' two ends.
    """
    dist, pos, _ = collision_primitive.plane_capsule(model, data, key, geom)
    normal, axis = data.geom_xmat[geom[:, 0]][:, :, 2], data.geom_xmat[geom[:, 1]][:, :, 2]
    tangent = axis - normal * (normal * axis).sum(axis=1, keepdims=True)
    norm = jnp.linalg.norm(tangent, axis=1, keepdims=True)
    is_defined = norm > _MIN_NORM
    tangent = jnp.where(is_defined, tangent / jnp.where(is_defined, norm, 1.0), jnp.array([1.0, 0.0, 0.0]))
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)], axis=1)
    return dist, pos, jnp.repeat(frame, 2, axis=0)


plane_capsule.ncon = 2  # type: ignore[attr-defined]


def install() -> None:
    """Have MJX call it."""
    collision_driver._COLLISION_FUNC[GeomType.PLANE, GeomType.CAPSULE] = plane_capsule
