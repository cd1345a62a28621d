"""Files of a MuJoCo model: where `xml_file` finds it."""

import os
from pathlib import Path

import gymnasium

from mjx_walk.utils.files import user_path

__all__ = ["ASSETS", "absolute_xml_file", "model_path"]

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
"""Gymnasium's models."""


def model_path(xml_file: str) -> Path:
    """Path of a model, found as Gymnasium finds it.

    The name of one of Gymnasium's assets is that asset, even if the working directory has such a file. With a leading
    `.`, `/` or `~` it is a path. Gymnasium refuses other names; here they are relative to the working directory.
    """
    return ASSETS / xml_file if is_asset(xml_file) else user_path(xml_file)


def is_asset(xml_file: str) -> bool:
    """Whether `xml_file` is the name of one of Gymnasium's assets."""
    return not xml_file.startswith((".", "/", "~")) and (ASSETS / xml_file).is_file()


def absolute_xml_file(xml_file: str, folder: Path) -> str:
    """An `xml_file` that stays the same model in another working directory.

    Names of assets and of missing files stay as they are. Links stay, because MuJoCo looks for included files beside
    them.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.
        folder: what a relative path is relative to.
    """
    path = os.path.abspath(folder / user_path(xml_file))  # MuJoCo reads `..` in the text of a path, too
    return xml_file if is_asset(xml_file) or not os.path.isfile(path) else path
