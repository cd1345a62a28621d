"""Targets of a model's motors: joints, tendons, sites or bodies."""

import mujoco
import numpy as np
from jaxtyping import Float, Int

__all__ = ["joint_of", "motor_dofs", "moved_joints", "torques_per_force"]

_TRN = mujoco.mjtTrn
_JNT, _WRAP = mujoco.mjtJoint, mujoco.mjtWrap
_ON_A_JOINT = (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT)
_ON_SITES = (_TRN.mjTRN_SITE, _TRN.mjTRN_SLIDERCRANK)
_OF_SEVERAL_AXES = (_JNT.mjJNT_FREE, _JNT.mjJNT_BALL)


def motor_dofs(model: mujoco.MjModel) -> Int[np.ndarray, " dofs"]:
    """Ascending indices in `qvel` of all axes of the joints that a motor moves; see `moved_joints`."""
    joints = set().union(*(moved_joints(model, motor) for motor in range(model.nu)))
    return np.flatnonzero(np.isin(model.dof_jntid, sorted(joints))).astype(np.int32)


def moved_joints(model: mujoco.MjModel, motor: int) -> set[int]:
    """Indices of the joints that a motor moves.

    A motor on a tendon moves the joints that change the tendon's length. One on sites moves the joints between the two
    sites, or between the site and the world. One that acts through the contacts of a body (adhesion) moves none.
    """
    kind, (first, second) = _TRN(model.actuator_trntype[motor]), model.actuator_trnid[motor]
    if kind in _ON_A_JOINT:
        return {int(first)}
    if kind == _TRN.mjTRN_TENDON:
        return _joints_of_tendon(model, first)
    if kind in _ON_SITES:
        return _joints_between(model, [model.site_bodyid[first], model.site_bodyid[second] if second >= 0 else 0])
    return set()


def joint_of(model: mujoco.MjModel, motor: int) -> int | None:
    """Index of the joint that a motor is attached to; None if it is attached to something else."""
    is_on_joint = _TRN(model.actuator_trntype[motor]) in _ON_A_JOINT
    return int(model.actuator_trnid[motor, 0]) if is_on_joint else None


def torques_per_force(model: mujoco.MjModel) -> Float[np.ndarray, " motors"]:
    """Torque or force on the joint, tendon or site for each unit of `actuator_force`, signed.

    A motor on a ball joint, a free joint or a site has an axis of its own in `gear`; others have one number.
    """
    gear = model.actuator_gear
    joints = [joint_of(model, motor) for motor in range(model.nu)]
    has_axis = [joint is not None and _JNT(model.jnt_type[joint]) in _OF_SEVERAL_AXES for joint in joints]
    has_axis |= model.actuator_trntype == _TRN.mjTRN_SITE
    largest = np.take_along_axis(gear, np.abs(gear).argmax(axis=1)[:, None], axis=1)[:, 0]
    return np.where(has_axis, np.sign(largest) * np.linalg.norm(gear, axis=1), gear[:, 0])


def _joints_of_tendon(model: mujoco.MjModel, tendon: int) -> set[int]:
    wrapped = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    joints: set[int] = set()
    branches: list[list[int]] = [[]]  # bodies that the tendon passes; each pulley begins another branch
    for number, found, coefficient in zip(
        model.wrap_type[wrapped], model.wrap_objid[wrapped], model.wrap_prm[wrapped], strict=True
    ):
        kind = _WRAP(number)  # a NumPy integer is in no tuple of constants
        if kind == _WRAP.mjWRAP_JOINT and coefficient:
            joints.add(int(found))
        elif kind == _WRAP.mjWRAP_PULLEY:
            branches.append([])
        elif kind == _WRAP.mjWRAP_SITE:
            branches[-1].append(model.site_bodyid[found])
        elif kind in (_WRAP.mjWRAP_SPHERE, _WRAP.mjWRAP_CYLINDER):
            branches[-1].append(model.geom_bodyid[found])
    return joints.union(*(_joints_between(model, bodies) for bodies in branches))


def _joints_between(model: mujoco.MjModel, bodies: list[int]) -> set[int]:
    """Joints that move some of the bodies relative to the others. Body 0 is the world."""
    chains: list[set[int]] = []
    for body in bodies:
        chain: set[int] = set()
        while body:
            chain |= set(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]))
            body = model.body_parentid[body]
        chains.append(chain)
    shared = chains[0].intersection(*chains) if chains else set()
    return set().union(*chains).difference(shared)
