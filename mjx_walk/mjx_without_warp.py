"""Imported before MJX and Brax, which imports MJX: where Warp is not installed, MJX prints two lines that say so.

Engines say it in their own line where it matters; every other command would begin with those two.
"""

import contextlib
import importlib.util
import io

if importlib.util.find_spec("warp") is None:
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx  # noqa: F401
