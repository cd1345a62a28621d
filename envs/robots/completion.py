"""Model files of robots, completed for a walking task: a floor, and a position servo for each hinge."""

import logging
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_walk.envs.models import load_compiled_spec, load_spec
from mjx_walk.envs.motors import joint_of
from mjx_walk.envs.robots.servos import Gains, Motors, gains, torque_motors
from mjx_walk.machine.quiet_mujoco import hide_deprecations
from mjx_walk.utils.errors import UserError

__all__ = ["Completed", "complete", "pose_within_ranges"]

_LOGGER = logging.getLogger(__name__)
_JNT = mujoco.mjtJoint
_FLOOR = "floor"
_FLOOR_SIZE = 20
"""Half the edge of the drawn floor, m; each of its squares has an edge of 1 m."""
_UNLIMITED = np.pi
"""Range of a servo whose joint has none, to both sides of its position in the first pose, rad."""


class Completed(NamedTuple):
    """A robot's model with a floor and servos."""

    model: mujoco.MjModel
    spec: mujoco.MjSpec
    """What `model` is compiled from, for further changes."""
    floor: float
    """Height of the floor, m."""


def complete(xml_file: str, motors: Motors) -> Completed:
    """Load a robot's model, and add what a walking task needs and the file lacks.

    The robot's root is the body with the free joint. What is added is logged, one line each.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.
        motors: values of added servos that replace the computed ones.

    Raises:
        UserError: the file is missing or invalid, its first joint is not free, or no hinge can be moved.
    """
    spec, model = load_compiled_spec(xml_file)
    _check_root(model, xml_file)
    changed = load_spec(xml_file)
    floors = _floors(model)
    if not floors.size:
        _add_floor(changed)
        _LOGGER.info("%s has no floor: added one at height 0", xml_file)
    added = _add_servos(changed, model, motors) if not model.nu else _replace_motors(changed, model, motors)
    if added or not floors.size:
        spec = changed
        spec.memory = spec.nstack = spec.njmax = spec.nconmax = -1  # MuJoCo chooses
        with hide_deprecations():
            model = spec.compile()
    return Completed(model, spec, float(model.geom_pos[floors[0], 2]) if floors.size else 0.0)


def pose_within_ranges(model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"]) -> Float[np.ndarray, " nq"]:
    """A pose with the angles of hinges and positions of sliders clipped to their ranges."""
    qpos = qpos.copy()
    for joint in np.flatnonzero(model.jnt_limited & np.isin(model.jnt_type, (_JNT.mjJNT_HINGE, _JNT.mjJNT_SLIDE))):
        address = model.jnt_qposadr[joint]
        qpos[address] = np.clip(qpos[address], *model.jnt_range[joint])
    return qpos


def _check_root(model: mujoco.MjModel, xml_file: str) -> None:
    """Check that the first joint is free, and that some joint is a hinge."""
    is_free = model.jnt_type == _JNT.mjJNT_FREE
    if not is_free.any():
        raise UserError(f"{xml_file} has no free joint, so it cannot walk; add <freejoint/> to the robot's root body")
    if not is_free[0]:
        raise UserError(f"the first joint of {xml_file} is not the robot's free joint; put the robot first")
    if not _hinges(model).size:
        body = model.body(model.jnt_bodyid[0]).name or "1"
        raise UserError(
            f"the body '{body}' of {xml_file}, the first with a free joint, has no hinge that a servo can move"
        )


def _hinges(model: mujoco.MjModel) -> Int[np.ndarray, " hinges"]:
    """Hinges of the body with the first joint and of its limbs."""
    is_robots = model.body_rootid[model.jnt_bodyid] == model.body_rootid[model.jnt_bodyid[0]]
    return np.flatnonzero(is_robots & (model.jnt_type == _JNT.mjJNT_HINGE))


def _floors(model: mujoco.MjModel) -> Int[np.ndarray, " floors"]:
    """Planes of the world with which geoms collide."""
    is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    return np.flatnonzero(is_plane & collides & (model.body_weldid[model.geom_bodyid] == 0))


def _add_floor(spec: mujoco.MjSpec) -> None:
    """Add a plane, and what films need: squares that show the speed, a light, and a sky if there is none."""
    taken = {geom.name for geom in spec.geoms} | {item.name for item in (*spec.materials, *spec.textures)}
    name = _FLOOR
    while name in taken:
        name = f"_{name}"
    spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.8, 0.9, 0.8],
        rgb2=[0.6, 0.7, 0.6],
        width=300,
        height=300,
    )
    material = spec.add_material(name=name, texrepeat=[_FLOOR_SIZE, _FLOOR_SIZE])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    size = [_FLOOR_SIZE, _FLOOR_SIZE, 0.05]
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_PLANE, size=size, contype=1, conaffinity=1, material=name
    )
    if not any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        spec.add_texture(
            name=f"{name}_sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.6, 0.75, 0.9],
            rgb2=[0.95, 0.97, 1.0],
            width=256,
            height=256,
        )
    # A light from straight above draws black stripes of the plane's own shadow.
    spec.worldbody.add_light(pos=[0, 0, 3], dir=[0.2, 0.1, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)


def _first_pose(model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
    """The first keyframe, or the model's own pose, with all joints inside their ranges."""
    return pose_within_ranges(model, model.key_qpos[0] if model.nkey else model.qpos0)


def _add_servos(spec: mujoco.MjSpec, model: mujoco.MjModel, motors: Motors) -> bool:
    """Add a servo to each hinge."""
    joints = _hinges(model)
    limits = [_joint_limit(model, int(joint)) for joint in joints]
    pose = _first_pose(model)
    found = gains(model, pose, joints, limits, motors)
    for joint, one in zip(joints, found, strict=True):
        target = spec.joints[joint]
        target.name = target.name or f"hinge_{joint}"
        servo = spec.add_actuator(name=f"{target.name}_servo", target=target.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        _make_servo(servo, target, one, _range(model, pose, int(joint)))
    _log("has no motors: added position servos to its hinges", joints, found)
    return True


def _replace_motors(spec: mujoco.MjSpec, model: mujoco.MjModel, motors: Motors) -> bool:
    """Make servos of the motors whose control is a torque, and give each servo a range. Returns whether any changed."""
    replaced = torque_motors(model)
    joints = np.array([joint_of(model, motor) for motor in replaced], int)
    limits = [_motor_limit(model, motor, joint) for motor, joint in zip(replaced, joints, strict=True)]
    pose = _first_pose(model)
    found = gains(model, pose, joints, limits, motors)
    for motor, joint, one in zip(replaced, joints, found, strict=True):
        _make_servo(spec.actuators[motor], spec.joints[joint], one, _range(model, pose, int(joint)))
    if replaced:
        _log("has motors of torque: made position servos of them", joints, found)
    unlimited = [motor for motor in range(model.nu) if motor not in replaced and not model.actuator_ctrllimited[motor]]
    for motor in unlimited:
        servo, joint = spec.actuators[motor], joint_of(model, motor)
        assert joint is not None
        servo.ctrllimited, servo.ctrlrange = mujoco.mjtLimited.mjLIMITED_TRUE, _range(model, pose, joint)
    return bool(replaced or unlimited)


def _make_servo(servo: mujoco.MjsActuator, joint: mujoco.MjsJoint, one: Gains, limits: tuple[float, float]) -> None:
    joint.armature = one.armature
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    servo.dyntype = mujoco.mjtDyn.mjDYN_NONE
    servo.gainprm[:3] = one.kp, 0.0, 0.0
    servo.biasprm[:3] = 0.0, -one.kp, -one.kd
    servo.gear[0] = 1.0
    servo.ctrllimited, servo.ctrlrange = mujoco.mjtLimited.mjLIMITED_TRUE, limits
    is_limited = mujoco.mjtLimited.mjLIMITED_TRUE if one.torque else mujoco.mjtLimited.mjLIMITED_FALSE
    servo.forcelimited, servo.forcerange = is_limited, (-(one.torque or 0.0), one.torque or 0.0)


def _range(model: mujoco.MjModel, pose: Float[np.ndarray, " nq"], joint: int) -> tuple[float, float]:
    """Range of a servo's control, rad."""
    if model.jnt_limited[joint]:
        return tuple(model.jnt_range[joint])
    position = pose[model.jnt_qposadr[joint]]
    return position - _UNLIMITED, position + _UNLIMITED


def _joint_limit(model: mujoco.MjModel, joint: int) -> float | None:
    """Torque limit of a joint in the file, N·m."""
    return float(np.abs(model.jnt_actfrcrange[joint]).max()) if model.jnt_actfrclimited[joint] else None


def _motor_limit(model: mujoco.MjModel, motor: int, joint: int) -> float | None:
    """Torque limit of a motor in the file, N·m: the lowest of those that its control, its force and its joint have."""
    gear, limits = abs(model.actuator_gear[motor, 0]), []
    if model.actuator_forcelimited[motor]:
        limits.append(gear * np.abs(model.actuator_forcerange[motor]).max())
    if model.actuator_ctrllimited[motor]:
        limits.append(gear * abs(model.actuator_gainprm[motor, 0]) * np.abs(model.actuator_ctrlrange[motor]).max())
    in_joint = _joint_limit(model, joint)
    return min([*map(float, limits), *([in_joint] if in_joint else [])], default=None)


def _log(what: str, joints: Int[np.ndarray, " servos"], found: list[Gains]) -> None:
    limits = [one.torque for one in found if one.torque]
    torque = f"at most {_span(limits)} N·m" if len(limits) == len(found) else "without torque limits"
    _LOGGER.info(
        "The model %s (%d; kp %s N·m/rad, kd %s N·m·s/rad, armature %s kg·m², %s); env.motors changes them",
        *(what, len(joints), _span([one.kp for one in found]), _span([one.kd for one in found])),
        *(_span([one.armature for one in found]), torque),
    )


def _span(values: list[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.3g}" if np.isclose(low, high) else f"{low:.3g} to {high:.3g}"
