"""Imported before MJX and before Brax, which imports MJX: the import is faster, and prints nothing.

MJX makes half a million objects, among which Python would search for garbage while they are made. Where Warp is not
installed, MJX prints two lines that say so; engines say it where it matters.
"""

import contextlib
import gc
import importlib.util
import io

_collects = gc.isenabled()
gc.disable()
try:
    with contextlib.nullcontext() if importlib.util.find_spec("warp") else contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx  # noqa: F401
finally:
    if _collects:
        gc.enable()
