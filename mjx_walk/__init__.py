"""mjx_walk: train simulated bodies to walk on the exact Gymnasium tasks, end to end on the device."""

import importlib
from typing import TYPE_CHECKING, Any

from mjx_walk.registration import register
from mjx_walk.xla_flags import turn_off_wrong_reductions

__version__ = "0.1.0"
__all__ = ["__version__", "load_run", "make_env", "run"]

if TYPE_CHECKING:
    from mjx_walk.api import load_run, run
    from mjx_walk.envs import make_env

_WHERE = {"make_env": "mjx_walk.envs", "run": "mjx_walk.api", "load_run": "mjx_walk.api"}


def __getattr__(name: str) -> Any:
    """Import JAX and MuJoCo only when something that needs them is used."""
    if name in _WHERE:
        return getattr(importlib.import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'mjx_walk' has no attribute '{name}'")


turn_off_wrong_reductions()
register()
