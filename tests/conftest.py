"""Tests run on the CPU, and share one compile cache within a run."""

import os
import tempfile

os.environ["JAX_PLATFORMS"] = "cpu"
_CACHE = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", tempfile.mkdtemp(prefix="mjx_walk_jax_"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
