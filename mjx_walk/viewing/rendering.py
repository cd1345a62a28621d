"""Rendering without a screen: which OpenGL, and films."""

import os
import subprocess
import sys
import warnings
from collections.abc import Iterable
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from mjx_walk.utils.errors import UserError

_PROBE = "import mujoco; mujoco.GLContext(64, 64).make_current()"


def choose_opengl() -> None:
    """Let MuJoCo render without a screen on Linux, by EGL or else by OSMesa; elsewhere its own choice is the right one.

    A `MUJOCO_GL` that is set already stays.

    Raises:
        UserError: neither works here.
    """
    if "MUJOCO_GL" in os.environ or sys.platform != "linux":
        return
    for name in ("egl", "osmesa"):
        # In a process of its own, since a broken driver may take the whole process down.
        probe = [sys.executable, "-c", _PROBE]
        if (
            subprocess.run(probe, env=os.environ | {"MUJOCO_GL": name}, capture_output=True, check=False).returncode
            == 0
        ):
            os.environ["MUJOCO_GL"] = name
            return
    raise UserError(
        "nothing to render with: install EGL or OSMesa (Debian and Ubuntu: apt-get install libegl1 libopengl0, or "
        "libosmesa6), or set MUJOCO_GL=glfw where there is a screen"
    )


def write_film(frames: Iterable[np.ndarray], path: Path, frames_per_second: float) -> None:
    """Write an MP4 (H.264).

    Args:
        frames: `[height, width, 3] u8` each, all of one size, which is cut to even numbers.
        path: of the file.
        frames_per_second: of the film.
    """
    frames = iter(frames)
    first = next(frames)
    height, width = (size // 2 * 2 for size in first.shape[:2])
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=frames_per_second, quality=7, macro_block_size=2, ffmpeg_log_level="error"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that JAX has threads, which starting ffmpeg does not copy
        writer.send(None)
    for frame in (first, *frames):
        writer.send(np.ascontiguousarray(frame[:height, :width]))
    writer.close()
