"""The pose in which a robot stands under its servos: a keyframe, or where a simulation settles."""

import logging
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_walk.envs.robots.completion import pose_within_ranges
from mjx_walk.envs.robots.surfaces import Surface, heights, surface
from mjx_walk.utils.errors import UserError

__all__ = ["Standing", "colliding_geoms", "standing_pose", "torso_geoms"]

_LOGGER = logging.getLogger(__name__)
_SECONDS = 1.0
"""A pose stands if the robot stands in it for this time."""
_LEAST_SECONDS = 0.3
"""A pose that stands for less is not taken."""
_UPRIGHT = 0.9
"""Least z of the torso's up-vector while it stands."""
_LEAST_HEIGHT = 0.75
"""Part of the first height above the floor that a standing torso keeps."""
_MAX_SPEED = 0.5
"""Largest speed of a torso that stands, m/s and rad/s."""
_CROUCHES = (0.1, 0.2, 0.3)
"""Parts of the height by which the legs of the model's own pose are bent, if it does not stand."""


class Standing(NamedTuple):
    """A standing robot, at rest on the floor."""

    qpos: Float[np.ndarray, " nq"]
    """m and rad."""
    targets: Float[np.ndarray, " nu"]
    """Controls of the servos that hold it, rad."""


class _Trial(NamedTuple):
    name: str
    seconds: float
    """For how long the robot stood."""
    standing: Standing


def standing_pose(model: mujoco.MjModel, floor: float, joints: Int[np.ndarray, " nu"]) -> Standing:
    """Find a pose in which a robot stands for a second under its servos.

    The first of these that stands is taken: the keyframes in order; the model's own pose; that pose with bent legs. If
    none stands, the one that stands longest is taken.

    Args:
        model: a completed model, whose first joint is the root's free joint.
        floor: height of the floor, m.
        joints: the joint of each servo.

    Raises:
        UserError: all of them fall at once.
    """
    every, torso = surface(model, colliding_geoms(model)), surface(model, torso_geoms(model))
    longest = _Trial("", 0.0, Standing(model.qpos0, np.zeros(model.nu)))
    for name, pose in _candidates(model, every):
        qpos = _on_floor(model, pose_within_ranges(model, pose), every, floor)
        targets = qpos[model.jnt_qposadr[joints]]
        seconds, settled = _hold(model, qpos, targets, torso, floor)
        if seconds >= _SECONDS:
            settled[:2] = qpos[:2]
            _LOGGER.info("The robot stands in %s", name)
            return Standing(settled, targets)
        _LOGGER.info("The robot does not stand for a second in %s", name)
        if seconds > longest.seconds:
            longest = _Trial(name, seconds, Standing(qpos, targets))
    if longest.seconds < _LEAST_SECONDS:
        raise UserError(
            "the robot stands neither in a keyframe nor in the model's own pose; add a keyframe in which it stands, or "
            "set env.motors.kp"
        )
    _LOGGER.warning("The robot stands for %.1f s in %s; its policy has to balance it", longest.seconds, longest.name)
    return longest.standing


def colliding_geoms(model: mujoco.MjModel) -> Int[np.ndarray, " geoms"]:
    """Geoms of the robot that can touch something."""
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    return np.flatnonzero(collides & (model.body_rootid[model.geom_bodyid] == model.jnt_bodyid[0]))


def torso_geoms(model: mujoco.MjModel) -> Int[np.ndarray, " geoms"]:
    """Geoms of the root body and of the bodies that are fixed to it: those that can touch something, or else all."""
    geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] == model.jnt_bodyid[0])
    touching = np.intersect1d(geoms, colliding_geoms(model))
    return touching if touching.size else geoms


def _candidates(model: mujoco.MjModel, every: Surface) -> Iterator[tuple[str, Float[np.ndarray, " nq"]]]:
    """Poses in which the robot may stand, with their names."""
    for key in range(model.nkey):
        yield f"the keyframe '{model.key(key).name or key}'", model.key_qpos[key]
    yield "the model's own pose", model.qpos0
    for part in _CROUCHES:
        yield f"the model's own pose with its legs bent by {part:.0%}", _crouched(model, every, part)


def _on_floor(
    model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"], every: Surface, floor: float
) -> Float[np.ndarray, " nq"]:
    """A pose whose lowest geom touches the floor."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_kinematics(model, data)
    data.qpos[2] += floor - heights(every, data.geom_xpos, data.geom_xmat).min()
    return data.qpos.copy()


def _hold(
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, " nq"],
    targets: Float[np.ndarray, " nu"],
    torso: Surface,
    floor: float,
) -> tuple[float, Float[np.ndarray, " nq"]]:
    """Hold a pose with the servos: for how many seconds the robot stands, at most `_SECONDS`, and its last pose."""
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos, targets
    num_steps = round(_SECONDS / model.opt.timestep)
    for step in range(num_steps):
        mujoco.mj_step(model, data)
        if not _stands(model, data, qpos, torso, floor):
            return step * model.opt.timestep, data.qpos.copy()
    is_still = np.abs(data.qvel[:6]).max() < _MAX_SPEED
    return (_SECONDS if is_still else _SECONDS - model.opt.timestep), data.qpos.copy()


def _stands(
    model: mujoco.MjModel, data: mujoco.MjData, start: Float[np.ndarray, " nq"], torso: Surface, floor: float
) -> bool:
    """Whether a robot that started at `start` still stands."""
    is_valid = not data.warning.number.any()
    is_upright = data.xmat[model.jnt_bodyid[0], 8] > _UPRIGHT
    is_high = data.qpos[2] - floor > _LEAST_HEIGHT * (start[2] - floor)
    is_free = heights(torso, data.geom_xpos, data.geom_xmat).min(initial=np.inf) > floor
    return bool(is_valid and is_upright and is_high and is_free)


def _crouched(model: mujoco.MjModel, every: Surface, part: float) -> Float[np.ndarray, " nq"]:
    """The model's own pose with its torso lowered over feet that stay where they are.

    Damped least squares on the lowest point of each limb, with joints inside their ranges.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    feet = _lowest_points(model, data, every)
    goals = {body: point for body, (_, point) in feet.items()}
    drop = part * (data.qpos[2] - min(point[2] for point in goals.values()))
    data.qpos[:] = pose_within_ranges(model, model.qpos0)
    data.qpos[2] = model.qpos0[2] - drop
    for _ in range(200):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        rows, errors = [], []
        for body, (local, _) in feet.items():
            point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ local
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, point, body)
            rows.append(jacobian[:, 6:])
            errors.append(goals[body] - point)
        matrix, error = np.concatenate(rows), np.concatenate(errors)
        step = np.zeros(model.nv)
        step[6:] = matrix.T @ np.linalg.solve(matrix @ matrix.T + 1e-3 * np.eye(len(error)), error)
        mujoco.mj_integratePos(model, data.qpos, 0.3 * step, 1.0)
        data.qpos[:] = pose_within_ranges(model, data.qpos)
    return data.qpos.copy()


def _lowest_points(
    model: mujoco.MjModel, data: mujoco.MjData, every: Surface
) -> dict[int, tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """The lowest point of each body near the lowest height: in the body's frame, and in the world."""
    found = heights(every, data.geom_xpos, data.geom_xmat)
    near = 0.1 * (data.qpos[2] - found.min())
    lowest: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for i in np.argsort(found):
        geom = every.geoms[i]
        body = int(model.geom_bodyid[geom])
        if found[i] > found.min() + near or body in lowest or model.body_weldid[body] == model.jnt_bodyid[0]:
            continue
        point = data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ every.points[i]
        lowest[body] = (data.xmat[body].reshape(3, 3).T @ (point - data.xpos[body]), point)
    return lowest
