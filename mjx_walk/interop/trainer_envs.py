"""Many environments for trainers of other projects, whose packages are imported at the first use."""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Union

from mjx_walk.envs import make_env
from mjx_walk.interop.env_batch import EnvBatch
from mjx_walk.utils.errors import UserError

if TYPE_CHECKING:
    import torch
    from stable_baselines3.common.vec_env import VecMonitor

    from mjx_walk.interop.rsl_rl_env import RslRlEnv
    from mjx_walk.interop.torch_env import TorchEnv

__all__ = ["make_rsl_rl_env", "make_sb3_env", "make_torch_env"]

_OPTIONAL = ("torch", "stable_baselines3", "rsl_rl", "tensordict")
"""Packages that an extra installs."""


def make_torch_env(
    env: str,
    num_envs: int,
    *,
    device: Union[str, "torch.device", None] = None,
    physics: str = "auto",
    **options: object,
) -> "TorchEnv":
    """Create environments whose observations, actions and rewards are PyTorch's tensors.

    Args:
        env: name of the task.
        num_envs: number of environments, B.
        device: `cuda` or `cpu`, the device on which JAX computes. It is the default.
        physics: engine.
        **options: Gymnasium's keywords, and those of `make_env`.

    Raises:
        UserError: an unknown name, engine or option, PyTorch is missing, or it does not use JAX's device.
    """
    module = _module("torch_env", "torch")
    batch = EnvBatch(make_env(env, physics, **options), num_envs)
    return module.TorchEnv(batch, module.shared_device(device))


def make_rsl_rl_env(
    env: str,
    num_envs: int,
    *,
    device: Union[str, "torch.device", None] = None,
    physics: str = "auto",
    seed: int | None = None,
    **options: object,
) -> "RslRlEnv":
    """Create environments for rsl_rl's runners.

    Args:
        env: name of the task.
        num_envs: number of environments, B.
        device: as for `make_torch_env`.
        physics: engine.
        seed: determines the random starts.
        **options: Gymnasium's keywords, and those of `make_env`.

    Raises:
        UserError: an unknown name, engine or option, or rsl_rl is missing.
    """
    module = _module("rsl_rl_env", "rsl_rl")
    return module.RslRlEnv(make_torch_env(env, num_envs, device=device, physics=physics, **options), seed)


def make_sb3_env(env: str, num_envs: int, *, physics: str = "auto", **options: object) -> "VecMonitor":
    """Create environments for Stable-Baselines3, in a `VecMonitor`, so that its logs show returns.

    Args:
        env: name of the task.
        num_envs: number of environments, B.
        physics: engine.
        **options: Gymnasium's keywords, and those of `make_env`.

    Raises:
        UserError: an unknown name, engine or option, or Stable-Baselines3 is missing.
    """
    module = _module("sb3_env", "sb3")
    return module.VecMonitor(module.SB3Env(EnvBatch(make_env(env, physics, **options), num_envs)))


def _module(name: str, extra: str) -> ModuleType:
    """A module of this room that imports optional packages, which an extra installs.

    Raises:
        UserError: the package is missing.
    """
    try:
        return importlib.import_module(f"mjx_walk.interop.{name}")
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        if package not in _OPTIONAL:
            raise
        raise UserError(f"{package} is missing: pip install 'mjx-walk[{extra}]'") from error
