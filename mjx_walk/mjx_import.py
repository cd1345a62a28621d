"""Imported before MJX and Brax, which imports MJX, so that commands begin and end sooner, and with lines of their own.

MJX makes half a million objects that stay. Python would look for garbage among them while they are made, again later,
and once more when the process ends: two seconds of every command. So all that is there once MJX is imported is exempt
from that search, which is what collects cycles; a caller's objects, too. And where Warp is not installed, MJX prints
two lines that say so; engines say it where it matters.
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
    gc.freeze()
finally:
    if _collects:
        gc.enable()
