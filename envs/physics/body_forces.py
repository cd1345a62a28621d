"""Accelerations of bodies and the forces between them, after a step of the `warp` engine.

Warp computes them before it integrates. Gymnasium calls `mj_rnePostConstraint` afterwards: it takes the positions and
forces of the last forward pass, but the velocities after the step.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from mujoco.mjx._src import math as mjx_math

from mjx_walk.envs.physics.base import Derived

__all__ = ["INPUTS", "OUTPUTS", "body_forces"]

OUTPUTS = ("cacc", "cfrc_int")
INPUTS = ("cdof", "cdof_dot", "cinert", "cvel", "cfrc_ext", "qacc")
"""Arrays of the last forward pass that they are computed from."""


def body_forces(model: mujoco.MjModel, arrays: Derived, qvel: Float[Array, "B nv"]) -> Derived:
    """The arrays `OUTPUTS` of a batch. Source: MuJoCo's `mj_rnePostConstraint`.

    Args:
        model: the model.
        arrays: `INPUTS` by name, with a batch axis.
        qvel: after the step.
    """
    with jax.default_matmul_precision("highest"):
        forces = jax.vmap(functools.partial(_body_forces, model))
        return forces({name: arrays[name] for name in INPUTS}, qvel)


def _body_forces(model: mujoco.MjModel, arrays: Derived, qvel: Float[Array, " nv"]) -> Derived:
    contains = _subtrees(model)
    has_gravity = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    world = np.concatenate([np.zeros(3), -model.opt.gravity if has_gravity else np.zeros(3)]).astype(np.float32)
    joint_acceleration = arrays["cdof_dot"] * qvel[:, None] + arrays["cdof"] * arrays["qacc"][:, None]
    cacc = world + contains.T[:, model.dof_bodyid].astype(np.float32) @ joint_acceleration
    momentum = jax.vmap(mjx_math.inert_mul)(arrays["cinert"], arrays["cvel"])
    change = jax.vmap(mjx_math.motion_cross_force)(arrays["cvel"], momentum)
    force = jax.vmap(mjx_math.inert_mul)(arrays["cinert"], cacc) + change - arrays["cfrc_ext"]
    force = force.at[0].set(0.0)  # the world does not move
    return {"cacc": cacc, "cfrc_int": jnp.asarray(contains, jnp.float32) @ force}


def _subtrees(model: mujoco.MjModel) -> Bool[np.ndarray, "nbody nbody"]:
    """Whether the subtree of the body of a row contains the body of a column."""
    contains = np.eye(model.nbody, dtype=bool)
    for body in range(1, model.nbody):  # parents come first
        contains[:, body] |= contains[:, model.body_parentid[body]]
    return contains
