"""Import MJX quickly and silently. Import this module before Brax, which imports MJX.

MJX creates half a million objects. The import disables garbage collection while it creates them. Without Warp, MJX
prints two lines about it. This module hides them, because engines report a missing Warp where it matters.
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
