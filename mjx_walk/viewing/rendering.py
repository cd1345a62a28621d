"""Rendering without a screen: the choice of OpenGL, and film files."""

import functools
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from mjx_walk.machine.opengl import has_screen
from mjx_walk.machine.subprocesses import python
from mjx_walk.storage.files import replacing
from mjx_walk.utils.errors import UserError

__all__ = ["choose_opengl", "write_film"]

_RENDERERS = ("egl", "osmesa", "glfw")
"""Values of `MUJOCO_GL` that Gymnasium renders with; the last one needs a screen."""
_PROBE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 64, 64).render()"
_PROBE_SECONDS = 60.0
"""Time after which a driver that hangs counts as one that does not render. A slow machine needs a few seconds."""


def choose_opengl() -> None:
    """Set `MUJOCO_GL` so that Gymnasium renders without a screen on Linux: EGL if it works, else OSMesa.

    A `MUJOCO_GL` that the user has set stays, if it works. Other systems need no setting.

    Raises:
        UserError: the user's setting does not work on this machine, or nothing does.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        if chosen not in _RENDERERS or not _works(chosen):
            others = [name for name in _RENDERERS if name != chosen and (name != "glfw" or has_screen())]
            raise UserError(f"MUJOCO_GL={chosen} does not render here; unset it, or try {' or '.join(others)}")
        return
    os.environ.pop("MUJOCO_GL", None)  # Gymnasium refuses an empty one
    if sys.platform != "linux":
        return
    for name in ("egl", "osmesa"):
        if _works(name):
            os.environ["MUJOCO_GL"] = name
            return
    raise UserError(
        "nothing to render with: install EGL or OSMesa (Debian and Ubuntu: apt-get install libegl1 libopengl0, or "
        "libosmesa6), or set MUJOCO_GL=glfw where there is a screen"
    )


@functools.cache
def _works(name: str) -> bool:
    """Whether MuJoCo renders with a value of `MUJOCO_GL`. A broken driver may crash, so a child process tries it."""
    env = os.environ | {"MUJOCO_GL": name}
    try:
        command = [*python(), "-c", _PROBE]
        return not subprocess.run(command, env=env, capture_output=True, timeout=_PROBE_SECONDS, check=False).returncode
    except subprocess.TimeoutExpired:
        return False


def write_film(frames: list[np.ndarray], path: Path, frames_per_second: float) -> None:
    """Write an MP4 (H.264).

    Args:
        frames: `[height, width, 3] u8` each, all of one size. An odd size is cut to an even one.
        path: of the file.
        frames_per_second: of the film.
    """
    height, width = (size // 2 * 2 for size in frames[0].shape[:2])
    even = [frame[:height, :width] for frame in frames]
    options: dict[str, Any] = {"quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    with warnings.catch_warnings(), replacing(path) as new:
        # Starting ffmpeg forks, and Python warns of a fork in a process with threads; JAX has some.
        warnings.simplefilter("ignore", RuntimeWarning)
        iio.imwrite(new, even, plugin="FFMPEG", fps=frames_per_second, **options)
