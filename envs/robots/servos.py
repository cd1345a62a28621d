"""Position servos of a robot: gains for those that a model file lacks, and what its own motors are."""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_walk.envs.motors import joint_of
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting

__all__ = ["Gains", "Motors", "effective_inertias", "gains", "is_servo", "torque_motors"]

_GRAVITY = 9.81
_STANDING_LEGS = 4
"""Limbs over which the weight is shared."""
_WEIGHT_ERROR = 0.2
"""Error of a joint that carries its share of the weight at the end of its limb, rad. The gain of the knees of MuJoCo
Playground's Go1, 35 N·m/rad, gives this error."""
_DAMPING_RATIO = 0.5
"""Damping of a joint whose foot is in the air, relative to critical damping."""
_NATURAL_FREQUENCY = 2 * np.pi * 10
"""Of a servo with its rotor alone, rad/s, where the file has no armature. Source: mjlab's robots. Without an armature,
light limbs such as wrists make the simulation unstable."""
_MAX_DAMPING = 0.5
"""Largest part of a joint's velocity that the damping takes in one physics step. With 2, it oscillates."""


@dataclasses.dataclass
class Motors:
    """Servos of joints for which the model file has none."""

    kp: float | None = setting(None, above=0)
    """Torque for an error of 1 rad, N·m. Default: by the weight, for an error of 0.2 rad."""
    kd: float | None = setting(None, at_least=0)
    """Torque for a velocity of 1 rad/s, N·m. Default: half of critical damping, by the inertia at the joint."""
    torque: float | None = setting(None, above=0)
    """Largest torque, N·m. Default: the file's limit; without one, torques are not limited."""
    armature: float | None = setting(None, at_least=0)
    """Inertia of the rotor at the joint, kg·m². Default: the file's; without one, for a natural frequency of 10 Hz."""


class Gains(NamedTuple):
    """Gains of one servo."""

    kp: float
    """N·m/rad."""
    kd: float
    """N·m·s/rad."""
    torque: float | None
    """Largest torque, N·m. None: not limited."""
    armature: float
    """Inertia of the rotor at the joint, kg·m²."""


def is_servo(model: mujoco.MjModel, motor: int) -> bool:
    """Whether a motor is a position servo of a joint: its control is a position of the joint."""
    is_affine = model.actuator_biastype[motor] == mujoco.mjtBias.mjBIAS_AFFINE
    is_fixed = model.actuator_gaintype[motor] == mujoco.mjtGain.mjGAIN_FIXED
    return bool(is_affine and is_fixed and model.actuator_biasprm[motor, 1] < 0 and joint_of(model, motor) is not None)


def torque_motors(model: mujoco.MjModel) -> list[int]:
    """Indices of the motors that a servo replaces: those whose control is a torque on a hinge.

    Raises:
        UserError: a motor is neither that nor a position servo.
    """
    found = []
    for motor in range(model.nu):
        joint = joint_of(model, motor)
        is_hinge = joint is not None and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        is_fixed = model.actuator_gaintype[motor] == mujoco.mjtGain.mjGAIN_FIXED
        has_bias = model.actuator_biastype[motor] != mujoco.mjtBias.mjBIAS_NONE
        if is_servo(model, motor):
            continue
        if not (is_hinge and is_fixed and not has_bias):
            name = model.actuator(motor).name or motor
            raise UserError(
                f"motor '{name}' of the model is neither a <position> servo nor a <motor> on a hinge; replace it, or "
                "remove <actuator>, and each hinge gets a servo"
            )
        found.append(motor)
    return found


def effective_inertias(
    model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"]
) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
    """Inertia at each degree of freedom while all others stand still, and while they are free, kg·m²."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return np.diag(inertia).copy(), 1.0 / np.diag(np.linalg.inv(inertia))


def gains(
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, " nq"],
    joints: Int[np.ndarray, " servos"],
    limits: list[float | None],
    motors: Motors,
) -> list[Gains]:
    """Gains of the servos of some hinges.

    Args:
        model: the model.
        qpos: the pose in which the robot stands, about.
        joints: the hinges.
        limits: torque limit of each hinge in the file, N·m, or None.
        motors: values that replace the computed ones.
    """
    fixed, free = effective_inertias(model, qpos)
    found = []
    for joint, in_file in zip(joints, limits, strict=True):
        dof = model.jnt_dofadr[joint]
        torque = motors.torque or in_file
        kp = motors.kp or _torque_of_weight(model, qpos, joint) / _WEIGHT_ERROR
        in_joint = float(model.dof_armature[dof])
        armature = (in_joint or kp / _NATURAL_FREQUENCY**2) if motors.armature is None else motors.armature
        added = armature - in_joint
        damping = 2 * _DAMPING_RATIO * np.sqrt(kp * (fixed[dof] + added)) - model.dof_damping[dof]
        largest = _MAX_DAMPING * (free[dof] + added) / model.opt.timestep
        kd = float(np.clip(damping, 0.0, max(largest, 0.0))) if motors.kd is None else motors.kd
        found.append(Gains(float(kp), kd, torque, float(armature)))
    return found


def _torque_of_weight(model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"], joint: int) -> float:
    """Torque on a joint from one leg's share of the weight at the far end of its limb, N·m."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    body = model.jnt_bodyid[joint]
    limb = [geom for geom in range(model.ngeom) if _is_below(model, model.geom_bodyid[geom], body)]
    reach = np.linalg.norm(data.geom_xpos[limb] - data.xanchor[joint], axis=1) + model.geom_rbound[limb]
    weight = model.body_subtreemass[model.body_rootid[body]] * _GRAVITY / _STANDING_LEGS
    return float(weight * reach.max(initial=0.0)) or 1.0


def _is_below(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    """Whether a body is `ancestor` or belongs to its subtree."""
    while body > ancestor:
        body = model.body_parentid[body]
    return bool(body == ancestor)
