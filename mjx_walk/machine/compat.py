"""Patches that the supported releases of JAX and MJX need. Programs call these functions; no import does."""

import contextlib
import gc
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from mjx_walk.storage.files import is_writable_folder, user_folder

__all__ = [
    "default_cache_dir",
    "exempt_imports_from_gc",
    "prepare_jax",
    "standard_dtypes",
    "standard_settings",
    "temporary_jax_settings",
]

_FUSION_TYPE = "--xla_cpu_experimental_ynn_fusion_type"


def prepare_jax() -> None:
    """Set the XLA flag that correct programs need on a CPU. Call it before JAX compiles its first program.

    From jaxlib 0.10.2 on, XLA hands reductions over large batches to YNNPACK, which reads uninitialized memory.
    In 0.10.2 the sums are wrong (jax-ml/jax#39103). In 0.11.2 MJX's steps are not finite either, as soon as new memory
    holds something other than zeros (`MALLOC_PERTURB_=128`). The flag keeps reductions in XLA's own code. A fusion type
    that `XLA_FLAGS` already names stays.

    Commands, `mjx_walk.run`, `mjx_walk.load_run` and `mjx_walk.make_env` call this function; further calls do nothing.
    It warns once if JAX already runs on a CPU without the flag.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _FUSION_TYPE in flags:
        return
    os.environ["XLA_FLAGS"] = f"{flags} {_FUSION_TYPE}=-reduce".lstrip()
    if _has_started() and jax.default_backend() == "cpu":
        warnings.warn(
            f"JAX started without XLA_FLAGS={_FUSION_TYPE}=-reduce and may sum wrongly over large batches on a CPU; "
            "call mjx_walk.prepare_jax() before you use JAX",
            stacklevel=3,
        )


def _has_started() -> bool:
    return jax._src.xla_bridge.backends_are_initialized()


@contextlib.contextmanager
def standard_dtypes() -> Iterator[None]:
    """Trace and run with 32-bit numbers and JAX's usual promotion, also under `JAX_ENABLE_X64=1`.

    It is a context manager and a decorator. It may be used while the caller's own 64-bit program is traced.
    """
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@contextlib.contextmanager
def standard_settings() -> Iterator[None]:
    """`standard_dtypes`, JAX's usual random numbers, compiled programs, and any transfers between host and device.

    The caller's settings then neither change nor stop a run. A warning says that `JAX_DISABLE_JIT` is ignored: Python
    would take minutes for an iteration, and some programs do not run at all.
    """
    if jax.config.jax_disable_jit:  # type: ignore[attr-defined]
        warnings.warn("JAX_DISABLE_JIT is ignored here: runs and policies are compiled", stacklevel=3)
    with (
        standard_dtypes(),
        jax.disable_jit(False),
        jax.default_prng_impl("threefry2x32"),
        jax.enable_custom_prng(False),
        jax.legacy_prng_key("allow"),
        jax.threefry_partitionable(True),
        jax.transfer_guard("allow"),
    ):
        yield


@contextlib.contextmanager
def temporary_jax_settings(matmul_precision: str) -> Iterator[None]:
    """Compile with standard settings, a matrix product precision and a compilation cache, until the block ends.

    A cache folder that the caller has chosen, by `JAX_COMPILATION_CACHE_DIR` or `jax.config`, stays.

    Args:
        matmul_precision: a value of `jax_default_matmul_precision`.
    """
    has_cache = jax.config.jax_compilation_cache_dir is not None  # type: ignore[attr-defined]
    with standard_settings(), jax.default_matmul_precision(matmul_precision):
        if has_cache:
            yield
            return
        folder = default_cache_dir()
        if not (folder and is_writable_folder(folder)):
            where = f"{folder} cannot be written" if folder else "there is no home folder"
            warnings.warn(f"compiled programs are not kept: {where}; set JAX_COMPILATION_CACHE_DIR", stacklevel=3)
            yield
            return
        _set_cache_dir(str(folder))
        try:
            yield
        finally:
            _set_cache_dir(None)


def _set_cache_dir(path: str | None) -> None:
    """Change JAX's cache folder. JAX opens a folder once, so it has to close the former one."""
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", path)


def default_cache_dir() -> Path | None:
    """The folder of compiled programs, below the user's cache folder. None if the user has no home folder."""
    folder = user_folder("XDG_CACHE_HOME", ".cache")
    return folder / "mjx_walk" / "jax" if folder else None


def exempt_imports_from_gc() -> None:
    """Exempt all present objects from garbage collection. Commands call this at their start.

    MJX creates half a million permanent objects. Otherwise Python searches them for cycles repeatedly, and once more
    when the process ends.
    """
    gc.freeze()
