"""Rendering without a screen: the choice of OpenGL, and film files."""

import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.files import replacing

_PROBE = "import mujoco; mujoco.GLContext(64, 64).make_current()"


def choose_opengl() -> None:
    """Set `MUJOCO_GL` so that MuJoCo renders without a screen on Linux: EGL if it works, else OSMesa.

    A `MUJOCO_GL` that the user has set stays. Other systems need no setting.

    Raises:
        UserError: neither works on this machine.
    """
    if "MUJOCO_GL" in os.environ or sys.platform != "linux":
        return
    for name in ("egl", "osmesa"):
        # A broken driver may crash the process, so each probe runs in its own.
        env = os.environ | {"MUJOCO_GL": name}
        if not subprocess.run([sys.executable, "-c", _PROBE], env=env, capture_output=True, check=False).returncode:
            os.environ["MUJOCO_GL"] = name
            return
    raise UserError(
        "nothing to render with: install EGL or OSMesa (Debian and Ubuntu: apt-get install libegl1 libopengl0, or "
        "libosmesa6), or set MUJOCO_GL=glfw where there is a screen"
    )


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
