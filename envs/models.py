"""MuJoCo models: where `xml_file` finds one, and loading it."""

from pathlib import Path

import gymnasium
import mujoco

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.quiet_mujoco import hide_deprecations


def model_path(xml_file: str) -> Path:
    """Path of a model by the rules of Gymnasium's `xml_file`: a bare name is an asset of Gymnasium."""
    path = Path(xml_file).expanduser()
    if len(path.parts) == 1 and not path.exists():
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
