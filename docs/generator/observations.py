"""Meaning of each number of a task's observation, found by observing states whose numbers are known."""

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_walk.envs import Task
from mjx_walk.envs.physics import PhysicsState

Name = tuple[str, str]
"""Meaning of a number, and its unit."""

_FREE_POSITION = [*((f"{axis} of", "m") for axis in "xyz"), *((f"quaternion {axis} of", "") for axis in "wxyz")]
_FREE_VELOCITY = [
    *((f"velocity along {axis} of", "m/s") for axis in "xyz"),
    *((f"angular velocity about {axis} of", "rad/s") for axis in "xyz"),
]
_BODY_ARRAYS = {
    "cinert": ("inertia (6), mass × position (3) and mass of", "kg·m², kg·m, kg"),
    "cvel": ("angular (3) and linear velocity (3) of", "rad/s, m/s"),
    "cfrc_ext": ("contact torque (3) and force (3) on", "N·m, N"),
}
"""Arrays of `mjData` with a row for each body, in a frame at the center of mass."""


class Entry(NamedTuple):
    """One row of an observation table."""

    first: int
    count: int
    name: str
    unit: str


def joint_positions(model: mujoco.MjModel) -> list[Name]:
    """Names of the elements of `qpos`."""
    return _of_joints(model, _FREE_POSITION, ("position of", "m"), ("angle of", "rad"))


def joint_velocities(model: mujoco.MjModel) -> list[Name]:
    """Names of the elements of `qvel`."""
    return _of_joints(model, _FREE_VELOCITY, ("velocity of", "m/s"), ("angular velocity of", "rad/s"))


def joint_forces(model: mujoco.MjModel, what: str) -> list[Name]:
    """Names of the elements of an array with a force for each degree of freedom."""
    force, torque = (f"{what} force on", "N"), (f"{what} torque on", "N·m")
    return _of_joints(model, [force] * 3 + [torque] * 3, force, torque)


def _of_joints(model: mujoco.MjModel, free: list[Name], slide: Name, hinge: Name) -> list[Name]:
    """Names of the elements that free joints, sliders and hinges have, each with the joint's name."""
    kinds = {mujoco.mjtJoint.mjJNT_FREE: free, mujoco.mjtJoint.mjJNT_SLIDE: [slide]}
    names: list[Name] = []
    for joint in map(model.joint, range(model.njnt)):
        elements = kinds.get(mujoco.mjtJoint(joint.type[0]), [hinge])
        names += [(f"{what} `{joint.name}`", unit) for what, unit in elements]
    return names


def observed(task: Task, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """The observation of a state whose derived arrays are zero."""
    blank = mujoco.MjData(task.model)
    derived = {name: jnp.zeros(getattr(blank, name).shape) for name in task.derived_names()}
    physics = PhysicsState(jnp.float32(qpos), jnp.float32(qvel), jnp.zeros(task.model.nv))
    return np.asarray(task.observe(physics, derived))


def entries(task: Task) -> list[Entry]:
    """The rows of the task's observation table, in order.

    Raises:
        ValueError: a number of the observation is not found in the state.
    """
    model = task.model
    qpos, qvel = 0.1 + 0.01 * np.arange(model.nq), 0.6 + 0.01 * np.arange(model.nv)
    values = observed(task, qpos, qvel)
    rows: list[Entry] = []
    start = 0
    for block, size in task.observation_blocks().items():
        part = values[start : start + size]
        for entry in _block(task, block, size, part, qpos, qvel):
            rows.append(entry._replace(first=start + entry.first))
        start += size
    assert start == task.observation_size
    return rows


def _block(task: Task, block: str, size: int, values: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> list[Entry]:
    model = task.model
    if block in _BODY_ARRAYS:
        what, unit = _BODY_ARRAYS[block]
        width = 10 if block == "cinert" else 6
        bodies = range(model.nbody - size // width, model.nbody)
        return [Entry(width * i, width, f"{what} {_body(model, b)}", unit) for i, b in enumerate(bodies)]
    if block in task.body_ids or block == "to_target":
        what = f"of body `{block}`" if block in task.body_ids else "of body `fingertip` relative to body `target`"
        return [Entry(i, 1, f"{axis} {what}", "m") for i, axis in enumerate("xyz"[:size])]
    if block in ("qfrc_actuator", "qfrc_constraint"):
        names = joint_forces(model, "motor" if block == "qfrc_actuator" else "constraint")
        chosen = names[:size] if block == "qfrc_constraint" else names[-size:]
        return [Entry(i, 1, *name) for i, name in enumerate(chosen)]
    known, names = (qvel, joint_velocities(model)) if block == "qvel" else (qpos, joint_positions(model))
    function = {"sin": np.sin, "cos": np.cos}.get(block)
    found = [np.flatnonzero(np.isclose(function(known) if function else known, value, atol=1e-4)) for value in values]
    if any(len(index) != 1 for index in found):
        raise ValueError(f"{task.options.name}: the block {block} of the observation is not found in the state")
    rows = [names[index[0]] for index in found]
    if function:
        titles = {"sin": "sine", "cos": "cosine"}
        rows = [(f"{titles[block]} of the {name}", "") for name, _ in rows]
    return [Entry(i, 1, *name) for i, name in enumerate(rows)]


def _body(model: mujoco.MjModel, body: int) -> str:
    name = model.body(body).name
    return f"`{name}`" if name else f"body {body}"


def clipped_to(task: Task) -> float | None:
    """The bound of observed velocities, or None."""
    far = observed(task, np.zeros(task.model.nq), np.full(task.model.nv, 1e3))
    return float(far.max()) if far.max() < 1e3 else None
