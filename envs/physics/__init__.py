"""Three physics engines with one interface: `warp` and `jax` (MJX), and `c` (MuJoCo's C library).

Simulation of a MuJoCo model, the choice of an engine and patches of MJX belong here.
Observations, rewards and episodes do not.
"""

import copy
import importlib.util
import warnings
from collections.abc import Mapping
from types import MappingProxyType

import mujoco
import numpy as np

from mjx_walk.envs.physics.approximations import warn_of_approximations
from mjx_walk.envs.physics.base import Derived, Engine, PhysicsState
from mjx_walk.envs.physics.derived_arrays import refuse_derived
from mjx_walk.envs.physics.preparation import nothing_runs
from mjx_walk.envs.physics.supported import refuse_unsupported, unsupported_by_mjx
from mjx_walk.machine.devices import default_backend, default_device
from mjx_walk.machine.nvidia import Machine, installed_version, warn_of_unused_gpu, warp_misfit
from mjx_walk.utils.errors import UserError

ENGINES = ("warp", "jax", "c")

__all__ = ["ENGINES", "Derived", "Engine", "PhysicsState", "make_engine", "nothing_runs", "resolve_engine"]


def resolve_engine(name: str) -> str:
    """Name of the engine to use on JAX's default device.

    Args:
        name: name of an engine, or `auto`: `c` on a CPU, `warp` on an NVIDIA GPU if Warp is installed and supports
            its driver, `jax` on any other accelerator.

    Raises:
        UserError: an unknown name, `warp` without Warp installed or with a driver that is too old, or `c` on an
            accelerator.
    """
    default_backend()  # says in one line why JAX does not start
    device = default_device()
    platform = device.platform
    if name != "c":
        warn_of_unused_gpu()
    has_warp = importlib.util.find_spec("warp") is not None
    is_nvidia = platform == "gpu" and "nvidia" in device.device_kind.lower()
    misfit = warp_misfit(Machine.seen(), installed_version("warp-lang")) if is_nvidia and has_warp else None
    if name == "auto":
        if platform == "cpu":
            return "c"
        if misfit:
            warnings.warn(f"physics=jax in place of Warp: {misfit}", stacklevel=2)
        return "warp" if is_nvidia and has_warp and not misfit else "jax"
    if name not in ENGINES:
        raise UserError(f"unknown physics '{name}'; choose one of: auto, {', '.join(ENGINES)}")
    if name == "warp" and not has_warp:
        raise UserError("physics=warp needs Warp: install it with pip install 'mjx-walk[warp]', or use physics=jax")
    if name == "warp" and misfit:
        raise UserError(f"physics=warp: {misfit}, or use physics=jax")
    if name == "c" and platform != "cpu":
        raise UserError(f"physics=c runs on the CPU, but JAX uses a {platform}; set JAX_PLATFORMS=cpu, or use auto")
    return name


def make_engine(
    name: str,
    model: mujoco.MjModel,
    num_substeps: int,
    derived: tuple[str, ...],
    models: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> Engine:
    """Create an engine.

    It imports the engine's module only now, so that Warp stays an optional dependency.

    Args:
        name: name of the engine, as `resolve_engine` returns it.
        model: the MuJoCo model as loaded.
        num_substeps: physics steps per environment step (Gymnasium's `frame_skip`).
        derived: names of the `mjData` arrays that the task reads.
        models: values of changed models by their names in `MjModel`, `[num_models, …]` each. If there are any,
            `PhysicsState.model_index` chooses one.

    Raises:
        UserError: the engine does not simulate something that the model has, or does not return a derived array.
    """
    refuse_unsupported(_most_slippery(model, models) if models else model, name)
    refuse_derived(model, name, derived)
    if name == "c":
        from mjx_walk.envs.physics.mujoco_c import CEngine

        return CEngine(model, num_substeps, derived, models)
    try:
        return _make_mjx_engine(name, model, num_substeps, derived, models)
    except UserError:
        raise
    except (NotImplementedError, ValueError) as error:
        raise unsupported_by_mjx(name, error) from error


def _most_slippery(model: mujoco.MjModel, models: Mapping[str, np.ndarray]) -> mujoco.MjModel:
    """The model with the least friction of all changed ones. Engines do not simulate every friction."""
    model = copy.copy(model)
    for name in models.keys() & {"geom_friction", "pair_friction"}:
        getattr(model, name)[:] = models[name].min(axis=0)
    return model


def _make_mjx_engine(
    name: str,
    model: mujoco.MjModel,
    num_substeps: int,
    derived: tuple[str, ...],
    models: Mapping[str, np.ndarray],
) -> Engine:
    from mjx_walk.machine import quiet_mjx  # noqa: F401  # isort: skip
    from mjx_walk.envs.physics.mjx_model import solver_iterations

    warn_of_approximations(model, name, solver_iterations(model))
    if name == "warp":
        from mjx_walk.envs.physics.mjx_warp import WarpEngine

        return WarpEngine(model, num_substeps, derived, models)
    from mjx_walk.envs.physics.mjx_jax import JaxEngine

    return JaxEngine(model, num_substeps, derived, models)
