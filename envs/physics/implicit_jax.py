"""Acceleration of MuJoCo's `implicitfast` integrator for the `jax` engine.

Source: `mj_implicitSkip`, `mjd_smooth_vel` and `mjd_actuator_vel` of MuJoCo. MJX 3.17's `implicit` differs from C. It
keeps derivatives of clamped forces and those between branches, and leaves out muscles and the rotation of free bodies.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from mujoco import mjx
from mujoco.mjx._src import support as mjx_support
from mujoco.mjx._src.types import BiasType, DisableBit, DynType, GainType

__all__ = ["acceleration"]


def acceleration(model: mjx.Model, data: mjx.Data) -> Float[Array, " nv"]:
    """Acceleration whose forces are those at the end of the substep, to first order in the velocity.

    Args:
        model: the MJX model.
        data: after a forward pass.
    """
    flags = model.opt.disableflags
    if flags & DisableBit.ACTUATION and flags & DisableBit.SPRING and flags & DisableBit.DAMPER:
        return data.qacc
    if not model.nv:
        return data.qacc
    mass = mjx_support.full_m(model, data)
    force = data.qfrc_smooth + data.qfrc_constraint
    factor, _ = jax.scipy.linalg.cho_factor(mass - model.opt.timestep * _velocity_derivative(model, data))
    qacc = jax.scipy.linalg.cho_solve((factor, False), force)
    for dof in _free_dofs(model):
        own = np.arange(dof, dof + 6)
        metric = _free_body_metric(model, data, dof, mass[np.ix_(own, own)])
        qacc = qacc.at[own].set(_solve(metric, force[own]))
    return qacc


def _velocity_derivative(model: mjx.Model, data: mjx.Data) -> Float[Array, "nv nv"]:
    """Derivative of the smooth forces by the velocity, where the mass matrix can have entries."""
    derivative = jnp.zeros((model.nv, model.nv))
    if model.nu and not model.opt.disableflags & DisableBit.ACTUATION:
        moment = data._impl.actuator_moment
        derivative += moment.T @ (_force_slopes(model, data)[:, None] * moment)
    if model.ntendon:
        tendon = data._impl.ten_J
        derivative -= tendon.T @ (model.tendon_damping[:, None] * tendon)
    return jnp.where(_is_related(model), derivative, 0.0) - jnp.diag(model.dof_damping)


def _force_slopes(model: mjx.Model, data: mjx.Data) -> Float[Array, " nu"]:
    """Derivative of each actuator's force by its velocity. Zero where `forcerange` clamps the force."""
    gain = jnp.where(model.actuator_gaintype == GainType.AFFINE, model.actuator_gainprm[:, 2], 0.0)
    muscles = np.flatnonzero(model.actuator_gaintype == GainType.MUSCLE)
    if muscles.size:
        slope = jax.vmap(jax.grad(mjx_support.muscle_gain, argnums=1))
        length, velocity = data.actuator_length[muscles], data._impl.actuator_velocity[muscles]
        ranges, acc0 = jnp.array(model.actuator_lengthrange)[muscles], jnp.array(model.actuator_acc0)[muscles]
        gain = gain.at[muscles].set(slope(length, velocity, ranges, acc0, model.actuator_gainprm[muscles]))
    drive = data.ctrl
    if not model.opt.disableflags & DisableBit.CLAMPCTRL:
        low, high = model.actuator_ctrlrange.T
        drive = jnp.where(model.actuator_ctrllimited, jnp.clip(drive, low, high), drive)
    if model.na:
        last = data.act[model.actuator_actadr + model.actuator_actnum - 1]
        drive = jnp.where(model.actuator_dyntype == DynType.NONE, drive, last)
    bias = jnp.where(model.actuator_biastype == BiasType.AFFINE, model.actuator_biasprm[:, 2], 0.0)
    low, high = model.actuator_forcerange.T
    is_clamped = model.actuator_forcelimited & ((data.actuator_force <= low) | (data.actuator_force >= high))
    return jnp.where(is_clamped, 0.0, bias + gain * drive)


def _is_related(model: mjx.Model) -> Bool[np.ndarray, "nv nv"]:
    """Whether one of two degrees of freedom is an ancestor of the other, or they are the same."""
    is_related = np.eye(model.nv, dtype=bool)
    for dof in range(model.nv):
        ancestor = model.dof_parentid[dof]
        while ancestor >= 0:
            is_related[dof, ancestor] = is_related[ancestor, dof] = True
            ancestor = model.dof_parentid[ancestor]
    return is_related


def _free_dofs(model: mjx.Model) -> list[int]:
    """First degree of freedom of each free body that no other joint moves with."""
    free = model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    return [int(dof) for dof in free if np.sum(model.dof_treeid == model.dof_treeid[dof]) == 6]


def _free_body_metric(model: mjx.Model, data: mjx.Data, dof: int, mass: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """Mass matrix of a free body less the derivative of its forces: damping, and the gyroscopic ones of its rotation.

    Source: `free_bias_vel_blocks` of MuJoCo Warp.
    """
    body = int(model.dof_bodyid[dof])
    xx, yy, zz, xy, xz, yz = data._impl.crb[body, :6]
    inertia = jnp.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    weight = data._impl.crb[body, 9]
    rotation, centre = data.xmat[body], data.subtree_com[body] - data.xpos[body]
    angular = rotation @ data.qvel[dof + 3 : dof + 6]
    change = jnp.outer(centre, angular) - jnp.eye(3) * (angular @ centre) + _cross(jnp.cross(angular, centre))
    torque = _cross(angular) @ inertia - _cross(inertia @ angular) - weight * _cross(centre) @ change
    upper = -weight * change @ rotation
    gyroscopic = jnp.block([[jnp.zeros((3, 3)), upper], [jnp.zeros((3, 3)), rotation.T @ torque @ rotation]])
    damping = jnp.diag(model.dof_damping[dof : dof + 6])
    return mass + model.opt.timestep * (damping + gyroscopic)


def _cross(vector: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Matrix that multiplies as the cross product with a vector from the left."""
    return jnp.cross(vector, jnp.eye(3)).T


def _solve(matrix: Float[Array, "6 6"], vector: Float[Array, " 6"]) -> Float[Array, " 6"]:
    """Solution of a linear system, by elimination without pivots: the matrix is close to a positive definite one.

    A factorization of XLA's could wait for another one on a CPU with two threads.
    """
    rows = jnp.concatenate([matrix, vector[:, None]], axis=1)
    for i in range(len(vector)):
        rows = rows.at[i].divide(rows[i, i])
        factors = rows[:, i].at[i].set(0.0)
        rows = rows - factors[:, None] * rows[i]
    return rows[:, -1]
