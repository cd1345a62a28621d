"""MuJoCo models: loading one, and looking up its parts."""

import copy
import logging
import os
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_walk.envs.model_files import ASSETS, changed_names, model_path, source_hashes
from mjx_walk.machine.quiet_mujoco import hide_deprecations, write_no_log
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import near_misses

__all__ = [
    "ModelNeeds",
    "body_id",
    "check_model",
    "check_pose",
    "is_coordinate",
    "load_compiled_spec",
    "load_model",
    "load_spec",
    "model_file",
    "warn_of_changed_sources",
    "warn_of_coordinates",
]

_LOGGER = logging.getLogger(__name__)


_TOO_LITTLE_MEMORY = (
    "its <size> leaves too little memory for its contacts and limits; remove memory, nstack, njmax and nconmax"
)
_LOST = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
"""MuJoCo's warnings that it has left out contacts or constraints."""
_EVERYWHERE = 1e3
"""Margin with which all contacts and limits act, m or rad."""


class ModelNeeds(NamedTuple):
    """Least sizes of a model, whose arrays a task reads by index."""

    positions: int = 1
    """Coordinates, MuJoCo's `nq`."""
    velocities: int = 1
    """Degrees of freedom, MuJoCo's `nv`."""
    sites: int = 0
    is_exact: bool = False
    """Whether a model with more positions or velocities is refused, too."""


def model_file(xml_file: str | None, task: str) -> str:
    """The model file of a task.

    Raises:
        UserError: the task has no model of its own, and none is given.
    """
    if xml_file is None:
        raise UserError(f"{task} has no model of its own; give the MuJoCo model of a robot: env.xml_file=PATH")
    return xml_file


def load_model(xml_file: str) -> mujoco.MjModel:
    """Load a MuJoCo model.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.

    Raises:
        UserError: the file does not exist, or MuJoCo cannot read it.
    """
    return load_compiled_spec(xml_file)[1]


def load_compiled_spec(xml_file: str) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Load a MuJoCo model, and the specification that it is compiled from, to change it.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.

    Raises:
        UserError: the file does not exist, or MuJoCo cannot read it.
    """
    write_no_log()
    path = Path(os.path.abspath(model_path(xml_file)))
    if not path.is_file():
        raise UserError(_not_found(xml_file, path))
    if "\\" in str(path):
        raise UserError(f"MuJoCo cannot open {path}: it takes the backslash for a separator; choose another path")
    try:
        with hide_deprecations():
            spec = mujoco.MjSpec.from_file(str(path))
            model = spec.compile()
    except ValueError as error:
        if "(increase <size memory" in str(error):
            raise UserError(f"{path}: {_TOO_LITTLE_MEMORY}") from error
        if "could not find decoder" in str(error):
            raise UserError(f"MuJoCo tells by the ending of {path} how to read it; let it end in .xml") from error
        raise UserError(f"MuJoCo cannot read {path}: {_in_one_line(str(error))}") from error
    has_sizes = any(size >= 0 for size in (spec.memory, spec.nstack, spec.njmax, spec.nconmax))
    if has_sizes and not _has_enough_memory(path, model):
        raise UserError(f"{path}: {_TOO_LITTLE_MEMORY}")
    return spec, model


def load_spec(xml_file: str) -> mujoco.MjSpec:
    """Load a model that `load_model` accepts, to change it. It is not compiled."""
    with hide_deprecations():
        return mujoco.MjSpec.from_file(os.path.abspath(model_path(xml_file)))


def _has_enough_memory(path: Path, model: mujoco.MjModel) -> bool:
    """Whether a model has the memory that MuJoCo chooses by default, or enough while every contact and limit acts.

    With less, MuJoCo leaves out constraints, or stops with an error in the middle of an episode.
    """
    spec = load_spec(str(path))
    spec.memory = spec.nstack = spec.njmax = spec.nconmax = -1
    with warnings.catch_warnings(action="ignore"), hide_deprecations():
        if model.narena >= spec.compile().narena:
            return True
    worst = copy.deepcopy(model)
    for margin in (worst.geom_margin, worst.pair_margin, worst.jnt_margin, worst.tendon_margin):
        margin[:] = _EVERYWHERE
    try:
        data = mujoco.MjData(worst)
        with warnings.catch_warnings(action="ignore"), hide_deprecations():
            mujoco.mj_step(worst, data)
    except (mujoco.FatalError, ValueError):
        return False
    return not data.warning.number[_LOST].any()


def warn_of_changed_sources(xml_file: str, sources: dict[str, str]) -> None:
    """Log a warning if who reads a model's files again, such as Gymnasium or a copy, reads another model.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.
        sources: the hashes when the model was loaded.

    Raises:
        UserError: the model file is gone.
    """
    path = model_path(xml_file)
    if not path.is_file():
        raise UserError(f"model file {path} is gone, and Gymnasium reads it again; restore it")
    changed = changed_names(sources, source_hashes(xml_file))
    if changed:
        _LOGGER.warning("%s has changed since it was loaded; it is used as it is now", path.parent / changed[0])


def _not_found(xml_file: str, path: Path) -> str:
    """The error for a model file that does not exist."""
    if path.is_dir():
        return f"model file not found: {xml_file} is a folder; write the path of an XML file"
    if len(Path(xml_file).parts) > 1:
        return f"model file not found: {path}"
    near = near_misses(xml_file, sorted(asset.name for asset in ASSETS.glob("*.xml")))
    hint = f"; did you mean: {', '.join(near)}?" if near else ""
    return f"model file not found: {xml_file} is neither in this folder nor one of Gymnasium's models{hint}"


def _in_one_line(error: str) -> str:
    """MuJoCo's error. Its first line may name only a number; further ones have the cause and the line of the file."""
    parser = re.search(r"ErrorID=\d+ \(0x\w+\) Line number=(\d+)", error)
    reason = re.search(r"Error=XML_ERROR_(\w+)", error)
    if parser and reason:
        return f"it is not valid XML; see line {parser[1]} ({reason[1].replace('_', ' ').lower()})"
    return "; ".join(line.strip() for line in error.splitlines() if line.strip())


def body_id(model: mujoco.MjModel, body: int | str) -> int:
    """Index of a body, given by its index or name.

    Raises:
        UserError: the model has no such body.
    """
    try:
        return int(model.body(body).id)
    except (KeyError, IndexError) as error:
        names = ", ".join(model.body(i).name or str(i) for i in range(model.nbody))
        raise UserError(f"the model has no body '{body}', which the task reads; its bodies: {names}") from error


def check_model(model: mujoco.MjModel, task: str, needs: ModelNeeds) -> None:
    """Check that a task can read a model, and that a policy can move its motors.

    Args:
        model: the model.
        task: name of the task.
        needs: what the task reads by index.

    Raises:
        UserError: the model is too small, has no motor, or has a motor without a control range.
    """
    least = "exactly" if needs.is_exact else "at least"
    for name, needed, found in (
        ("positions (nq)", needs.positions, model.nq),
        ("velocities (nv)", needs.velocities, model.nv),
        ("site(s)", needs.sites, model.nsite),
    ):
        if found < needed or (needs.is_exact and found > needed and name != "site(s)"):
            has = found or "no joints" if name.startswith("positions") else found
            raise UserError(f"{task} needs a model with {least} {needed} {name}; this one has {has}")
    if not model.nu:
        raise UserError(f"{task} needs a model with motors; this one has no <actuator>")
    if model.nu != model.nactuator:
        raise UserError("the model has motors with several controls; give each motor one control")
    low, high = model.actuator_ctrlrange.T
    for i in np.flatnonzero(~(np.isfinite(low) & np.isfinite(high) & (low < high))):
        motor = model.actuator(int(i)).name or int(i)
        inherited = ', or inheritrange="1"' if _is_servo_of_range(model, int(i)) else ""
        raise UserError(f"motor '{motor}' of the model has no control range; set its ctrlrange=\"LOW HIGH\"{inherited}")


def _is_servo_of_range(model: mujoco.MjModel, motor: int) -> bool:
    """Whether a motor is a position servo whose joint or tendon has a range, which MuJoCo can take for the control."""
    target, kind = model.actuator_trnid[motor, 0], model.actuator_trntype[motor]
    is_limited = (kind == mujoco.mjtTrn.mjTRN_JOINT and model.jnt_limited[target]) or (
        kind == mujoco.mjtTrn.mjTRN_TENDON and model.tendon_limited[target]
    )
    gain, bias = model.actuator_gainprm[motor, 0], model.actuator_biasprm[motor, 1]
    return bool(is_limited and gain > 0 and gain == -bias)


def check_pose(model: mujoco.MjModel, derived: Iterable[str]) -> None:
    """Check that the model can be simulated from its own pose. Huge masses, forces and distances overflow.

    Args:
        model: the model.
        derived: names of the `mjData` arrays that the task reads.

    Raises:
        UserError: a position, an acceleration or an array that the task reads is not finite in float32.
    """
    data = mujoco.MjData(model)
    with hide_deprecations():
        mujoco.mj_forward(model, data)
    for name in ("qpos", "qacc", *derived):
        with np.errstate(over="ignore"):
            values = np.asarray(getattr(data, name)).astype(np.float32)
        if not np.isfinite(values).all():
            raise UserError(
                f"the model cannot be simulated: {name} is not finite in its own pose; check its masses, sizes, forces "
                "and positions"
            )


def warn_of_coordinates(model: mujoco.MjModel, task: str, has_x: bool, height: int | None) -> None:
    """Log a warning if a task reads other coordinates of a model as x and as the height, as Gymnasium does.

    Args:
        model: the model.
        task: name of the task.
        has_x: whether the task reads `qpos[0]` as x.
        height: index in `qpos` that the task reads as the height, if it reads one.
    """
    read = [(0, 0, "x")] if has_x else []
    read += [(height, 2, "height")] if height is not None else []
    for index, axis, name in read:
        if not is_coordinate(model, index, axis):
            _LOGGER.warning(
                "qpos[%d] of this model is not the %s, but %s reads it as such, as Gymnasium does", index, name, task
            )


def is_coordinate(model: mujoco.MjModel, index: int, axis: int) -> bool:
    """Whether an element of `qpos` is the root's position along an axis of the world.

    Args:
        model: the model.
        index: of the element.
        axis: 0 for x, 1 for y, 2 for z.
    """
    if index >= model.nq:
        return False
    joint = int(np.flatnonzero(model.jnt_qposadr <= index)[-1])
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
        return index - model.jnt_qposadr[joint] == axis
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    is_root = model.body_parentid[model.jnt_bodyid[joint]] == 0
    return bool(is_root and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE and data.xaxis[joint, axis] > 0.99)
