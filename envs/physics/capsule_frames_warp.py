"""The patch of `capsule_frames_jax` for MuJoCo Warp."""

# mypy: ignore-errors
# Warp compiles the source of the function; its types are not Python's.

import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive
from mujoco.mjx.third_party.mujoco_warp._src.collision_primitive_core import mat23f
from mujoco.mjx.third_party.mujoco_warp._src.collision_primitive_core import plane_capsule as upstream_plane_capsule

__all__ = ["install", "plane_capsule"]


@wp.func
def plane_capsule(
    plane_normal: wp.vec3,
    plane_pos: wp.vec3,
    capsule_pos: wp.vec3,
    capsule_axis: wp.vec3,
    capsule_radius: float,
    capsule_half_length: float,
) -> tuple[wp.vec2, mat23f, wp.mat33]:
    """Contacts between a plane and a capsule, with the frames of MuJoCo's C library."""
    dist, pos, frame = upstream_plane_capsule(
        plane_normal, plane_pos, capsule_pos, capsule_axis, capsule_radius, capsule_half_length
    )
    tangent = wp.normalize(capsule_axis - plane_normal * wp.dot(plane_normal, capsule_axis))
    if wp.length_sq(tangent) < 0.5:  # the capsule is parallel to the normal
        tangent = wp.vec3(1.0, 0.0, 0.0)
    n = plane_normal
    c = wp.cross(n, tangent)
    frame = wp.mat33(n[0], n[1], n[2], tangent[0], tangent[1], tangent[2], c[0], c[1], c[2])
    return dist, pos, frame


def install() -> None:
    """Replace Warp's `plane_capsule`. Call it before Warp builds the collision kernels."""
    collision_primitive.plane_capsule = plane_capsule
