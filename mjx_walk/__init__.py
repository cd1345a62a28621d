"""mjx_walk: train simulated bodies to walk on the exact Gymnasium tasks, entirely on the device.

Importing the package registers the tasks with Gymnasium and does nothing else.
"""

import importlib
from typing import TYPE_CHECKING, Any

from mjx_walk.interop.registration import register
from mjx_walk.machine.opengl import import_mujoco
from mjx_walk.utils.versions import __version__

__all__ = [
    "BraxEnv",
    "GymnaxEnv",
    "__version__",
    "from_brax",
    "from_gymnax",
    "load_run",
    "make_env",
    "make_rsl_rl_env",
    "make_sb3_env",
    "make_torch_env",
    "prepare_jax",
    "register_algorithm",
    "register_task",
    "run",
]

if TYPE_CHECKING:
    from mjx_walk.algos import register_algorithm
    from mjx_walk.api import load_run, run
    from mjx_walk.envs import make_env, register_task
    from mjx_walk.interop.brax_env import BraxEnv
    from mjx_walk.interop.from_brax import from_brax
    from mjx_walk.interop.from_gymnax import from_gymnax
    from mjx_walk.interop.gymnax_env import GymnaxEnv
    from mjx_walk.interop.trainer_envs import make_rsl_rl_env, make_sb3_env, make_torch_env
    from mjx_walk.machine.compat import prepare_jax

_WHERE = {
    "BraxEnv": "mjx_walk.interop.brax_env",
    "GymnaxEnv": "mjx_walk.interop.gymnax_env",
    "from_brax": "mjx_walk.interop.from_brax",
    "from_gymnax": "mjx_walk.interop.from_gymnax",
    "load_run": "mjx_walk.api",
    "make_env": "mjx_walk.envs",
    "make_rsl_rl_env": "mjx_walk.interop.trainer_envs",
    "make_sb3_env": "mjx_walk.interop.trainer_envs",
    "make_torch_env": "mjx_walk.interop.trainer_envs",
    "prepare_jax": "mjx_walk.machine.compat",
    "register_algorithm": "mjx_walk.algos",
    "register_task": "mjx_walk.envs",
    "run": "mjx_walk.api",
}


def __getattr__(name: str) -> Any:
    """Import JAX and MuJoCo at the first use of a name that needs them."""
    if name in _WHERE:
        return getattr(importlib.import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'mjx_walk' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)


import_mujoco()
register()
