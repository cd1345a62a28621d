"""What the releases of JAX and MJX that we run on need, set by whoever starts a program, never by an import."""

import gc
import os
import warnings

import jax

_FUSION_TYPE = "--xla_cpu_experimental_ynn_fusion_type"


def prepare_jax() -> None:
    """Set what correct programs need, before JAX compiles the first one; a later call changes nothing.

    XLA compiles reductions on a CPU itself, unless `XLA_FLAGS` names another fusion type. From jaxlib 0.10.2 on it
    hands those over large batches to YNNPACK, which reads memory that was never written. It sums wrongly in 0.10.2
    (jax-ml/jax#39103), and MJX's steps are not finite in 0.11.2 either, as soon as new memory holds something other
    than zeros (`MALLOC_PERTURB_=128`).

    Commands, `mjx_walk.run` and `mjx_walk.make_env` call this. It warns where JAX has started without the flag.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _FUSION_TYPE in flags:
        return
    os.environ["XLA_FLAGS"] = f"{flags} {_FUSION_TYPE}=-reduce".lstrip()
    if _has_started() and jax.default_backend() == "cpu":
        warnings.warn(
            f"JAX started without XLA_FLAGS={_FUSION_TYPE}=-reduce, and may sum wrongly over large batches on a CPU; "
            "call mjx_walk.prepare_jax() before you use JAX",
            stacklevel=3,
        )


def _has_started() -> bool:
    return jax._src.xla_bridge.backends_are_initialized()


def exempt_imports_from_gc() -> None:
    """Exempt all objects that exist now from garbage collection; for commands, at their start.

    MJX makes half a million objects that stay. Python would search them for cycles again and again, and once more when
    the process ends.
    """
    gc.freeze()
