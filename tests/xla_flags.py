"""XLA's flags for tests on a CPU."""

from importlib.metadata import version

SAFE_REDUCTIONS = "--xla_cpu_experimental_ynn_fusion_type=-reduce"
"""What `mjx_walk.prepare_jax` sets."""


def quick_compile(level: int) -> str:
    """Flags that cut compile times.

    Args:
        level: XLA's optimization level.
    """
    flags = f"--xla_backend_optimization_level={level}"
    # XLA ends the process at a flag that it does not know.
    return flags if version("jaxlib") >= "0.11" else f"{flags} --xla_cpu_use_fusion_emitters=false"
