"""MuJoCo models: where `xml_file` finds one, loading it, and looking up its parts."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from jaxtyping import Int

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.quiet_mujoco import hide_deprecations


def model_path(xml_file: str) -> Path:
    """Path of a model. A bare name is one of Gymnasium's assets, even if the working directory has such a file."""
    path = Path(xml_file).expanduser()
    if len(path.parts) == 1:
        return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / xml_file
    return path


def load_model(xml_file: str) -> mujoco.MjModel:
    """Load a MuJoCo model.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.

    Raises:
        UserError: the file does not exist, or MuJoCo cannot read it.
    """
    path = model_path(xml_file)
    if not path.is_file():
        raise UserError(f"model file not found: {path}")
    try:
        with hide_deprecations():
            return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise UserError(f"MuJoCo cannot read {path}: {str(error).splitlines()[0]}") from error


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


def motor_dofs(model: mujoco.MjModel) -> Int[np.ndarray, " motors"]:
    """Ascending indices in `qvel` of the joints with a motor."""
    is_on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    return np.unique(model.jnt_dofadr[model.actuator_trnid[is_on_joint, 0]])
