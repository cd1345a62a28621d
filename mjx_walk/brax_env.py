"""The former module of `mjx_walk.BraxEnv`."""

import warnings

from mjx_walk.interop.brax_env import BraxEnv

__all__ = ["BraxEnv"]

warnings.warn("mjx_walk.brax_env.BraxEnv is now mjx_walk.BraxEnv", DeprecationWarning, stacklevel=2)
