"""A patch of MJX's contact frames between capsules and planes: the first tangent follows the capsule, as in C.

MJX 3.17 uses a default tangent when the capsule is within 30° of the plane's normal. It tests the length of the axis
after the projection onto the plane. With a pyramidal friction cone, the tangent affects the friction forces.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Int
from mujoco.mjx._src import collision_driver, collision_primitive
from mujoco.mjx._src.collision_types import Collision
from mujoco.mjx._src.types import Data, GeomType, Model

__all__ = ["install", "plane_capsule"]

_MIN_NORM = 1e-15


def plane_capsule(model: Model, data: Data, key: object, geom: Int[Array, "N 2"]) -> Collision:
    """Contacts between planes and capsules, with the frames of MuJoCo's C library.

    Source: `mjraw_PlaneCapsule` and `mju_makeFrame` of MuJoCo.

    Args:
        model: the MJX model.
        data: the MJX data, with the geoms' poses.
        key: unused.
        geom: indices of the plane and the capsule of each pair.

    Returns:
        Distances `[2N]`, positions `[2N, 3]` and frames `[2N, 3, 3]`, one contact for each end of a capsule.
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
    """Register `plane_capsule` with MJX."""
    collision_driver._COLLISION_FUNC[GeomType.PLANE, GeomType.CAPSULE] = plane_capsule
