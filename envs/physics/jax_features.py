"""Features of a model that the `jax` engine alone does not simulate."""

import itertools
from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Shaped

from mjx_walk.envs.physics.elements import (
    constraint_settings,
    contact_friction,
    moving_bodies,
    names_of_pair,
    pairs_that_move,
)
from mjx_walk.envs.physics.feature_table import FeatureTable, Mask, any_of, name_of

__all__ = ["JAX_FEATURES"]

JAX_FEATURES = FeatureTable()

_JAX = ("jax",)
_MOST_TURNING = 25.0
"""Largest ratio of mobilities in `_turning_bodies`. With a wheel of ratio 16 on the floor, 90% of the velocities differ
from C's by at most 3e-5, relative to one plus their change. With 36 it is 7e-3. With 14,400 the largest error is 80."""


@JAX_FEATURES.entry(
    _JAX,
    "body",
    "contacts of a body whose joints turn it almost about its center of mass",
    "move the body's joint or mass by a fifth of its size",
)
def _turning_bodies(model: mujoco.MjModel) -> Mask:
    """Moving bodies with contacts whose centre of mass the joints move far less than the surface around it.

    `jax` regularizes a contact by the mobility of the centre of mass, and its solver computes in float32.
    """
    geoms = np.unique(pairs_that_move(model)[0])
    bodies = model.geom_bodyid[geoms]
    distance = np.linalg.norm(model.geom_pos[geoms] - model.body_ipos[bodies], axis=1) + model.geom_rbound[geoms]
    reach = np.zeros(model.nbody)
    np.maximum.at(reach, bodies, distance)
    centre, turning = model.body_invweight0.T
    return moving_bodies(model) & (turning * reach**2 > _MOST_TURNING * centre)


@JAX_FEATURES.entry(
    _JAX,
    None,
    "contacts of these types of geoms",
    "use capsules or boxes instead, or exclude them with contype and conaffinity",
)
def _other_collisions(model: mujoco.MjModel) -> Iterator[str]:
    """Pairs of geoms without a collision function in MJX: cylinders or ellipsoids with boxes or meshes, for example."""
    from mjx_walk.machine import quiet_mjx  # noqa: F401  # isort: skip
    from mujoco.mjx._src.collision_driver import has_collision_fn

    for both in pairs_that_move(model)[0]:
        kinds = model.geom_type[both]
        if not has_collision_fn(*kinds):
            names = " and ".join(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in kinds)
            yield f"{names}, {names_of_pair(model, both)}"


@JAX_FEATURES.entry(_JAX, None, "a margin of meshes and height fields", "remove margin from both geoms")
def _mesh_margins(model: mujoco.MjModel) -> Iterator[str]:
    """Contacts with a margin of which one geom is a mesh or a height field."""
    geoms, pairs = pairs_that_move(model)
    is_mesh = np.isin(model.geom_type[geoms], (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)).any(axis=1)
    margin = model.geom_margin[geoms].sum(axis=1)
    margin[pairs >= 0] = model.pair_margin[pairs[pairs >= 0]]
    for both in geoms[is_mesh & (margin != 0)]:
        yield names_of_pair(model, both)


@JAX_FEATURES.entry(_JAX, None, "elliptic contacts without friction", 'set condim="3", or cone="pyramidal" in <option>')
def _elliptic_without_friction(model: mujoco.MjModel) -> Iterator[str]:
    """Contacts of dimension one in a model with elliptic cones."""
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        return
    geoms, pairs = pairs_that_move(model)
    for both in geoms[contact_friction(model, geoms, pairs)[0] == 1]:
        yield names_of_pair(model, both)


@JAX_FEATURES.entry(_JAX, None, "a solimp of width zero as MuJoCo does", "set its third number to more than zero")
def _solimps_without_width(model: mujoco.MjModel) -> Iterator[str]:
    """Elements with a `solimp` of width zero, where MuJoCo takes the mean of `dmin` and `dmax`."""
    for kind, index, _, (dmin, dmax, width, *_) in constraint_settings(model):
        if width <= mujoco.mjMINVAL and dmin != dmax:
            yield name_of(model, kind, index)


@JAX_FEATURES.entry(_JAX, "tendon", "a sidesite on another body than its geom", "move the site to the geom's body")
def _side_sites_elsewhere(model: mujoco.MjModel) -> Mask:
    """Tendons around a geom whose side site is on another body. MJX compares their positions within their bodies."""
    is_geom = np.isin(model.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER))
    wraps = np.flatnonzero(is_geom & (model.wrap_prm >= 0))
    sites, geoms = model.wrap_prm[wraps].astype(int), model.wrap_objid[wraps]
    elsewhere = wraps[model.site_bodyid[sites] != model.geom_bodyid[geoms]]
    ends = zip(model.tendon_adr, model.tendon_num, strict=True)
    return np.array([np.any((elsewhere >= first) & (elsewhere < first + num)) for first, num in ends], bool)


@JAX_FEATURES.entry(
    _JAX,
    "actuator",
    "direct-current motors and orientation servos",
    "use <motor>, <position> or <velocity>",
)
def _newer_motors(model: mujoco.MjModel) -> Mask:
    is_newer = np.isin(model.actuator_gaintype, (mujoco.mjtGain.mjGAIN_DCMOTOR, mujoco.mjtGain.mjGAIN_SO3))
    is_newer |= np.isin(model.actuator_biastype, (mujoco.mjtBias.mjBIAS_DCMOTOR, mujoco.mjtBias.mjBIAS_SO3))
    return is_newer | (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR)


@JAX_FEATURES.entry(_JAX, "actuator", "actearly", "remove actearly")
def _early_motors(model: mujoco.MjModel) -> Mask:
    """Motors whose force follows the activation of the next substep. MJX takes the present one."""
    return model.actuator_actearly.astype(bool) & (model.actuator_actadr >= 0)


@JAX_FEATURES.entry(
    _JAX, None, "implicitfast in a medium", 'set density and viscosity to 0, or integrator="Euler", in <option>'
)
def _implicit_fluid(model: mujoco.MjModel) -> list[str]:
    """A medium with the implicit integrator. MJX has no derivatives of its forces."""
    is_implicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return [name for name in ("density", "viscosity") if is_implicit and getattr(model.opt, name) > 0]


@JAX_FEATURES.entry(_JAX, "actuator", "actuator damping", "set damping on the joint")
def _damped_motors(model: mujoco.MjModel) -> Mask:
    return any_of(model.actuator_damping, model.actuator_dampingpoly)


@JAX_FEATURES.entry(_JAX, "joint", "polynomial stiffness and damping", "give the joint one stiffness and one damping")
def _polynomial_joints(model: mujoco.MjModel) -> Mask:
    """Joints whose stiffness or damping has terms of higher order."""
    damping = any_of(model.dof_dampingpoly)[model.jnt_dofadr] if model.njnt else np.zeros(0, bool)
    return any_of(model.jnt_stiffnesspoly) | damping


@JAX_FEATURES.entry(_JAX, "tendon", "polynomial stiffness and damping", "give the tendon one stiffness and one damping")
def _polynomial_tendons(model: mujoco.MjModel) -> Mask:
    return any_of(model.tendon_stiffnesspoly, model.tendon_dampingpoly)


@JAX_FEATURES.entry(_JAX, "tendon", "the armature of a tendon across branches as MuJoCo does", "remove armature")
def _branching_armatures(model: mujoco.MjModel) -> Mask:
    """Tendons with armature that couple joints of different branches. C leaves out such entries of the mass matrix."""
    is_on_chain = np.array([_is_chain(model, _dofs_of(model, tendon)) for tendon in range(model.ntendon)], bool)
    return (model.tendon_armature > 0) & ~is_on_chain


def _dofs_of(model: mujoco.MjModel, tendon: int) -> Shaped[np.ndarray, " n"]:
    """Ascending degrees of freedom that can change a tendon's length."""
    first = model.ten_J_rowadr[tendon]
    return model.ten_J_colind[first : first + model.ten_J_rownnz[tendon]]


def _is_chain(model: mujoco.MjModel, dofs: Shaped[np.ndarray, " n"]) -> bool:
    """Whether each degree of freedom is an ancestor of the next."""
    for ancestor, dof in itertools.pairwise(dofs):
        while dof > ancestor:
            dof = model.dof_parentid[dof]
        if dof != ancestor:
            return False
    return True


@JAX_FEATURES.entry(_JAX, "geom", "adhesion", "remove adhesion")
def _adhesive_geoms(model: mujoco.MjModel) -> Mask:
    return any_of(model.geom_adhesion)


@JAX_FEATURES.entry(_JAX, "pair", "adhesion", "remove adhesion")
def _adhesive_pairs(model: mujoco.MjModel) -> Mask:
    return any_of(model.pair_adhesion)


@JAX_FEATURES.entry(_JAX, "geom", "moving surfaces", "remove surfacevel")
def _moving_surfaces(model: mujoco.MjModel) -> Mask:
    return any_of(model.geom_surfacevel)


@JAX_FEATURES.entry(_JAX, "geom", "the fluid forces of individual geoms", "remove fluidshape and fluidcoef")
def _fluid_geoms(model: mujoco.MjModel) -> Mask:
    """Geoms with fluid forces of their own, in a medium."""
    has_medium = model.opt.density > 0 or model.opt.viscosity > 0
    return (model.geom_fluid[:, 0] > 0) & has_medium
