"""Tests run on the CPU, share one compile cache within a run, and have XLA compile quickly.

A program is compiled for seconds here and runs for less; what calls back into Python, as MuJoCo's C library does, no
cache can keep. These flags compile it in a third of the time; the tests hold without them, too, but take longer.
"""

import os
import tempfile

os.environ["JAX_PLATFORMS"] = "cpu"
_QUICKLY = "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false"
_FLAGS = os.environ.get("XLA_FLAGS", "")
if _QUICKLY not in _FLAGS:  # as it is where one of pytest-xdist's processes begins
    os.environ["XLA_FLAGS"] = f"{_QUICKLY} {_FLAGS}".rstrip()
_CACHE = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", tempfile.mkdtemp(prefix="mjx_walk_jax_"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
