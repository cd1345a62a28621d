"""OpenGL of this machine, and MuJoCo's import where `MUJOCO_GL` does not work or a standard stream is closed.

This module does not import JAX.
"""

import os
import sys

from mjx_walk.machine.streams import with_standard_streams

__all__ = ["has_screen", "import_mujoco"]


def has_screen() -> bool:
    """Whether there is a screen to open a window on."""
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


def import_mujoco() -> None:
    """Import MuJoCo without OpenGL if `MUJOCO_GL` is invalid, or names a library that is missing.

    MuJoCo's own import fails then. `viewing.rendering.choose_opengl` reports such a value when something is rendered.
    Without `MUJOCO_GL` this function does nothing: the first module that needs MuJoCo imports it. It does import MuJoCo
    where a standard stream is closed. GLFW, which MuJoCo imports, starts a child process that needs all of them.
    """
    chosen = os.environ.get("MUJOCO_GL")
    with with_standard_streams() as are_needed:
        if chosen:
            _import_with(chosen)
        elif are_needed:
            import mujoco  # noqa: F401


def _import_with(chosen: str) -> None:
    """Import MuJoCo with a value of `MUJOCO_GL`, and without OpenGL if that fails."""
    try:
        import mujoco
    except Exception:  # each library fails with another type
        os.environ["MUJOCO_GL"] = "disable"
        try:
            import mujoco
        finally:
            os.environ["MUJOCO_GL"] = chosen
        # The submodules that the first import has loaded are not loaded again, so they are not bound again either.
        for name, module in list(sys.modules.items()):
            package, _, submodule = name.rpartition(".")
            if package == "mujoco":
                setattr(mujoco, submodule, module)
