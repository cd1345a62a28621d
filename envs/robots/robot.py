"""A robot as a walking task reads it: joints, servos, standing pose and feet."""

import dataclasses
import logging
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_walk.envs.motors import joint_of
from mjx_walk.envs.robots.completion import complete
from mjx_walk.envs.robots.servos import Motors
from mjx_walk.envs.robots.standing_pose import colliding_geoms, standing_pose, torso_geoms
from mjx_walk.envs.robots.surfaces import Surface, surface, touching_geoms
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import near_misses

__all__ = ["Robot", "load_robot", "with_ground"]

_LOGGER = logging.getLogger(__name__)
_TOUCH = 0.02
"""Geoms touch the floor up to this height, relative to the height of the standing root."""


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A model whose first joint is the root's free joint, with a position servo for each joint that moves it."""

    model: mujoco.MjModel
    spec: mujoco.MjSpec
    """What the model without hills is compiled from, for further changes."""
    root: int
    """The body with the free joint."""
    floor: float
    """Height of the floor, m."""
    standing: Float[np.ndarray, " nq"]
    """The standing pose, at rest on the floor, m and rad."""
    targets: Float[np.ndarray, " nu"]
    """Controls of the servos that hold the standing pose, rad."""
    positions: Int[np.ndarray, " nu"]
    """Index in `qpos` of the joint of each servo."""
    velocities: Int[np.ndarray, " nu"]
    """Index in `qvel` of the joint of each servo."""
    feet: tuple[Surface, ...]
    """The surface of each foot."""
    torso: Surface
    """The surface of the root body and of the bodies that are fixed to it."""


def load_robot(xml_file: str, motors: Motors, feet: Sequence[str] = ()) -> Robot:
    """Load a robot's model, complete it, and find its standing pose and its feet.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.
        motors: values of added servos that replace the computed ones.
        feet: names of geoms or bodies. Default: the bodies that touch the floor in the standing pose.

    Raises:
        UserError: the file is missing or invalid, the model is no robot that can walk, it does not stand, or a foot is
            unknown.
    """
    model, spec, floor = complete(xml_file, motors)
    joints = np.array([joint_of(model, motor) for motor in range(model.nu)], int)
    standing = standing_pose(model, floor, joints)
    found = [_named_foot(model, name) for name in feet] or _feet(model, standing.qpos, floor)
    _LOGGER.info("Feet: %s", ", ".join(_name(model, geoms) for geoms in found))
    return Robot(
        model=model,
        spec=spec,
        root=int(model.jnt_bodyid[0]),
        floor=floor,
        standing=standing.qpos,
        targets=standing.targets,
        positions=model.jnt_qposadr[joints],
        velocities=model.jnt_dofadr[joints],
        feet=tuple(surface(model, geoms) for geoms in found),
        torso=surface(model, torso_geoms(model)),
    )


def with_ground(robot: Robot, model: mujoco.MjModel) -> Robot:
    """The robot in its model with more geoms of the world, which come after the others there."""
    first = int((robot.model.geom_bodyid == 0).sum())
    added = model.ngeom - robot.model.ngeom
    moved = [part._replace(geoms=part.geoms + added * (part.geoms >= first)) for part in (*robot.feet, robot.torso)]
    return dataclasses.replace(robot, model=model, feet=tuple(moved[:-1]), torso=moved[-1])


def _feet(model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"], floor: float) -> list[Int[np.ndarray, " geoms"]]:
    """Geoms that touch the floor in the standing pose, by body, without bodies that carry another one of these."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    every = surface(model, np.setdiff1d(colliding_geoms(model), torso_geoms(model)))
    geoms = touching_geoms(every, data, floor, _TOUCH * (qpos[2] - floor))
    bodies = model.geom_bodyid[geoms]
    if not geoms.size:
        raise UserError("no limb of the robot touches the floor in its standing pose; name its feet: env.feet=[NAME]")
    feet = [body for body in np.unique(bodies) if not any(_is_above(model, body, other) for other in bodies)]
    return [geoms[bodies == body] for body in feet]


def _is_above(model: mujoco.MjModel, body: int, other: int) -> bool:
    """Whether a body carries another one, over any number of joints."""
    while other > body:
        other = model.body_parentid[other]
        if other == body:
            return True
    return False


def _named_foot(model: mujoco.MjModel, name: str) -> Int[np.ndarray, " geoms"]:
    """The geom of a name, or all geoms that can touch something of the body of a name.

    Raises:
        UserError: there is none.
    """
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    geoms = colliding_geoms(model)
    found = np.array([geom]) if geom >= 0 else geoms[model.geom_bodyid[geoms] == body]
    if geom < 0 and body < 0:
        bodies = np.unique(model.geom_bodyid[geoms])
        names = [*(model.geom(geom).name for geom in geoms), *(model.body(body).name for body in bodies)]
        near = near_misses(name, sorted({*filter(None, names)}))
        hint = f"did you mean: {', '.join(near)}?" if near else f"bodies: {', '.join(names[len(geoms) :])}"
        raise UserError(f"env.feet: the model has no geom or body '{name}'; {hint}")
    if not found.size:
        raise UserError(f"env.feet: the body '{name}' has no geom that can touch the floor; name another body")
    return found


def _name(model: mujoco.MjModel, geoms: Int[np.ndarray, " geoms"]) -> str:
    body = model.geom_bodyid[geoms[0]]
    return model.body(body).name or f"body {body}"
