"""What OpenGL this machine has, and MuJoCo's import where `MUJOCO_GL` does not work: only rendering needs OpenGL.

This module does not import JAX.
"""

import os
import sys

__all__ = ["has_screen", "import_mujoco"]


def has_screen() -> bool:
    """Whether there is a screen to open a window on."""
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


def import_mujoco() -> None:
    """Import MuJoCo without OpenGL if `MUJOCO_GL` is invalid, or names a library that is missing.

    MuJoCo's own import fails then. `viewing.rendering.choose_opengl` reports such a value when something is rendered.
    Without `MUJOCO_GL` this function does nothing: the first module that needs MuJoCo imports it.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if not chosen:
        return
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
