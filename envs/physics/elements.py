"""Elements of a model that use a feature, for the table of `supported`."""

import itertools
from collections.abc import Callable, Iterator

import mujoco
import numpy as np
from jaxtyping import Int, Shaped

__all__ = [
    "LEAST_PYRAMIDAL_FRICTION",
    "Users",
    "any_of",
    "balanced_bodies",
    "branching_armatures",
    "disabled_motors",
    "fluid_geoms",
    "motors_limited_twice",
    "moving_equalities",
    "name_of",
    "named",
    "negative_joints",
    "negative_tendons",
    "option",
    "overlapping_joint_limits",
    "overlapping_tendon_limits",
    "pairs_that_move",
    "parallel_capsules",
    "plugins",
    "polynomial_joints",
    "side_sites_elsewhere",
    "slippery_contacts",
    "turning_bodies",
    "unmoved_tendons",
    "user_motors",
]

Users = Callable[[mujoco.MjModel], Iterator[str]]
"""The elements of a model that use a feature, as `kind 'name'`."""

LEAST_PYRAMIDAL_FRICTION = 0.05
"""With it, velocities after a step differ from C's by at most 1.1e-3, relative to one plus their change."""

_MOST_TURNING = 25.0
"""Largest ratio of mobilities in `turning_bodies`. With a wheel of ratio 16 on the floor, 90% of the velocities differ
from C's by at most 3e-5, relative to one plus their change. With 36 it is 7e-3. With 14,400 the largest error is 80."""

_SPOKEN = {"actuator": "motor", "eq": "equality constraint", "pair": "contact pair"}


def named(
    kind: str, is_user: Callable[[mujoco.MjModel], Shaped[np.ndarray, " n"]]
) -> Callable[[mujoco.MjModel], Iterator[str]]:
    """The elements of one kind for which a condition on the model's arrays holds."""

    def users(model: mujoco.MjModel) -> Iterator[str]:
        for i in np.flatnonzero(is_user(model)):
            yield name_of(model, kind, int(i))

    return users


def name_of(model: mujoco.MjModel, kind: str, index: int) -> str:
    """An element as `kind 'name'`, or with its index if it has no name."""
    name = getattr(model, kind)(index).name
    return f"{_SPOKEN.get(kind, kind)} '{name}'" if name else f"{_SPOKEN.get(kind, kind)} {index}"


def option(
    text: str, is_used: Callable[[mujoco.MjOption], bool | int | float]
) -> Callable[[mujoco.MjModel], Iterator[str]]:
    """The `<option>` for which a condition holds."""

    def users(model: mujoco.MjModel) -> Iterator[str]:
        if is_used(model.opt):
            yield text

    return users


def any_of(*arrays: Shaped[np.ndarray, "n ..."]) -> Shaped[np.ndarray, " n"]:
    """For each element, whether any value of any array is not zero."""
    return np.array([any(np.any(row) for row in rows) for rows in zip(*arrays, strict=True)], bool)


def plugins(model: mujoco.MjModel) -> Iterator[str]:
    for i in range(model.nplugin):
        yield f"plugin instance {i}"


def disabled_motors(model: mujoco.MjModel) -> Shaped[np.ndarray, " motors"]:
    """Motors of a group that `actuatorgroupdisable` names. Groups outside 0 to 30 cannot be disabled."""
    group = model.actuator_group
    return (group >= 0) & (group <= 30) & (model.opt.disableactuator >> np.clip(group, 0, 30) & 1).astype(bool)


def polynomial_joints(model: mujoco.MjModel) -> Shaped[np.ndarray, " joints"]:
    """Joints whose stiffness or damping has terms of higher order."""
    damping = any_of(model.dof_dampingpoly)[model.jnt_dofadr] if model.njnt else np.zeros(0, bool)
    return any_of(model.jnt_stiffnesspoly) | damping


def fluid_geoms(model: mujoco.MjModel) -> Shaped[np.ndarray, " geoms"]:
    """Geoms with fluid forces of their own, in a medium."""
    has_medium = model.opt.density > 0 or model.opt.viscosity > 0
    return (model.geom_fluid[:, 0] > 0) & has_medium


def moving_equalities(model: mujoco.MjModel) -> Shaped[np.ndarray, " equalities"]:
    """Active equalities whose Jacobian changes with the position. MuJoCo adds a term for that change, MJX does not."""
    is_off = model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    is_moving = np.isin(model.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))
    return is_moving & model.eq_active0.astype(bool) & (not is_off)


def overlapping_joint_limits(model: mujoco.MjModel) -> Shaped[np.ndarray, " joints"]:
    """Joints whose upper and lower limit can act at the same time. MJX has one row for both, MuJoCo has two."""
    is_scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    return is_scalar & _overlap(model, model.jnt_limited, model.jnt_range, model.jnt_margin)


def overlapping_tendon_limits(model: mujoco.MjModel) -> Shaped[np.ndarray, " tendons"]:
    """Tendons whose upper and lower limit can act at the same time."""
    return _overlap(model, model.tendon_limited, model.tendon_range, model.tendon_margin)


def _overlap(
    model: mujoco.MjModel,
    limited: Shaped[np.ndarray, " n"],
    limits: Shaped[np.ndarray, "n 2"],
    margin: Shaped[np.ndarray, " n"],
) -> Shaped[np.ndarray, " n"]:
    """Whether both limits can act at the same time."""
    is_on = not model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return (limited != 0) & (limits[:, 1] - limits[:, 0] < 2 * margin) & is_on


def unmoved_tendons(model: mujoco.MjModel) -> Shaped[np.ndarray, " tendons"]:
    """Constrained tendons without inertia in the model's own pose. MJX's solver divides by it."""
    is_constrained = (model.tendon_limited != 0) | (model.tendon_frictionloss > 0)
    is_tendon = model.eq_type == mujoco.mjtEq.mjEQ_TENDON
    for tied in (model.eq_obj1id[is_tendon], model.eq_obj2id[is_tendon]):
        is_constrained[tied[tied >= 0]] = True
    return is_constrained & (model.tendon_invweight0 < mujoco.mjMINVAL)


def slippery_contacts(model: mujoco.MjModel) -> Iterator[str]:
    """Pairs of geoms whose pyramidal contacts have little friction.

    A pyramidal contact divides by the square of its friction, and MJX computes in float32.
    """
    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return
    geoms, pairs = pairs_that_move(model)
    condim, friction = _contact_friction(model, geoms, pairs)
    for both in geoms[(condim > 1) & (friction < LEAST_PYRAMIDAL_FRICTION)]:
        yield "geoms " + " and ".join(f"'{model.geom(int(geom)).name or geom}'" for geom in both)


def pairs_that_move(model: mujoco.MjModel) -> tuple[Int[np.ndarray, "n 2"], Int[np.ndarray, " n"]]:
    """Pairs of geoms that may touch, of which at least one moves, and the indices of their `<pair>`, or -1."""
    from mjx_walk.machine import quiet_mjx  # noqa: F401  # isort: skip
    from mujoco.mjx._src import collision_driver

    is_off = model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    pairs = np.array([] if is_off else [*collision_driver.geom_pairs(model)], int).reshape(-1, 3)
    pairs = pairs[_moving_bodies(model)[model.geom_bodyid[pairs[:, :2]]].any(axis=1)]
    return pairs[:, :2], pairs[:, 2]


def _moving_bodies(model: mujoco.MjModel) -> Shaped[np.ndarray, " bodies"]:
    return model.body_dofnum[model.body_weldid] > 0


def _contact_friction(
    model: mujoco.MjModel, geoms: Int[np.ndarray, "n 2"], pairs: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " n"], Shaped[np.ndarray, " n"]]:
    """Dimension and sliding friction of the contacts of pairs of geoms, as C combines them."""
    priority = model.geom_priority[geoms]
    is_used = priority == priority.max(axis=1, keepdims=True)
    condim = np.where(is_used, model.geom_condim[geoms], 0).max(axis=1)
    friction = np.where(is_used, model.geom_friction[geoms, 0], 0.0).max(axis=1)
    is_own = pairs >= 0
    condim[is_own], friction[is_own] = model.pair_dim[pairs[is_own]], model.pair_friction[pairs[is_own], 0]
    return condim, friction


def branching_armatures(model: mujoco.MjModel) -> Shaped[np.ndarray, " tendons"]:
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


def balanced_bodies(model: mujoco.MjModel) -> Shaped[np.ndarray, " bodies"]:
    """Moving bodies with contacts whose centre of mass no joint moves. MJX's solver divides by their inertia, zero."""
    collides = np.zeros(model.nbody, bool)
    collides[model.geom_bodyid[pairs_that_move(model)[0]]] = True
    return _moving_bodies(model) & collides & (model.body_invweight0[:, 0] < mujoco.mjMINVAL)


def turning_bodies(model: mujoco.MjModel) -> Shaped[np.ndarray, " bodies"]:
    """Moving bodies with contacts whose centre of mass the joints move far less than the surface around it.

    `jax` regularizes a contact by the mobility of the centre of mass, and its solver computes in float32.
    """
    geoms = np.unique(pairs_that_move(model)[0])
    bodies = model.geom_bodyid[geoms]
    distance = np.linalg.norm(model.geom_pos[geoms] - model.body_ipos[bodies], axis=1) + model.geom_rbound[geoms]
    reach = np.zeros(model.nbody)
    np.maximum.at(reach, bodies, distance)
    centre, turning = model.body_invweight0.T
    return _moving_bodies(model) & (turning * reach**2 > _MOST_TURNING * centre)


def parallel_capsules(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Pairs of capsules that may touch and are parallel in every pose. MuJoCo gives them two contacts, `jax` one."""
    geoms = pairs_that_move(model)[0]
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


def motors_limited_twice(model: mujoco.MjModel) -> Shaped[np.ndarray, " motors"]:
    """Motors with a limit on their own force, of several on a tendon that limits their sum."""
    on_tendon = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    tendon = np.where(on_tendon, model.actuator_trnid[:, 0], 0)
    num_motors = np.bincount(tendon[on_tendon], minlength=max(model.ntendon, 1))
    is_limited = model.tendon_actfrclimited.astype(bool) if model.ntendon else np.zeros(1, bool)
    return on_tendon & model.actuator_forcelimited.astype(bool) & is_limited[tendon] & (num_motors[tendon] > 1)


def user_motors(model: mujoco.MjModel) -> Shaped[np.ndarray, " motors"]:
    """Motors whose force a callback gives. Without one, MuJoCo has a gain of one, MJX of zero."""
    return (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_USER) | (
        model.actuator_biastype == mujoco.mjtBias.mjBIAS_USER
    )


def negative_joints(model: mujoco.MjModel) -> Shaped[np.ndarray, " joints"]:
    """Joints with negative damping or friction, which MuJoCo accepts."""
    is_negative = np.zeros(model.njnt, bool)
    is_negative[model.dof_jntid[(model.dof_damping < 0) | (model.dof_frictionloss < 0)]] = True
    return is_negative


def negative_tendons(model: mujoco.MjModel) -> Shaped[np.ndarray, " tendons"]:
    """Tendons with negative damping or friction."""
    return (model.tendon_damping < 0) | (model.tendon_frictionloss < 0)


def side_sites_elsewhere(model: mujoco.MjModel) -> Shaped[np.ndarray, " tendons"]:
    """Tendons around a geom whose side site is on another body. MJX compares their positions within their bodies."""
    is_geom = np.isin(model.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER))
    wraps = np.flatnonzero(is_geom & (model.wrap_prm >= 0))
    sites, geoms = model.wrap_prm[wraps].astype(int), model.wrap_objid[wraps]
    elsewhere = wraps[model.site_bodyid[sites] != model.geom_bodyid[geoms]]
    first = model.tendon_adr
    return np.array(
        [np.any((elsewhere >= a) & (elsewhere < a + n)) for a, n in zip(first, model.tendon_num, strict=True)], bool
    )
