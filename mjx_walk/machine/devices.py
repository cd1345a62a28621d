"""The devices of this machine: their number, their memory, and which one a process sees."""

import os
import subprocess

import jax

from mjx_walk.machine.subprocesses import python
from mjx_walk.utils.errors import UserError

__all__ = ["count_devices", "default_backend", "default_device", "device_memory", "num_bytes", "only_device"]


def default_backend() -> str:
    """Name of JAX's default backend, such as `cpu` or `gpu`.

    Raises:
        UserError: JAX does not start, for example because `JAX_PLATFORMS` names what this machine does not have.
    """
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        chosen = jax.config.jax_platforms  # type: ignore[attr-defined]
        asked = f" with JAX_PLATFORMS={chosen}" if chosen else ""
        reason = " ".join(str(error).split()) or "there is no such device; unset it, or set JAX_PLATFORMS=cpu"
        raise UserError(f"JAX does not start{asked}: {reason}") from error


def count_devices() -> tuple[str, int]:
    """`gpu` or `cpu`, and the number of devices. A CPU counts as one.

    A child process asks JAX, because JAX claims the memory of all GPUs that it initializes.

    Raises:
        UserError: JAX does not start.
    """
    code = "import jax; print(jax.default_backend() != 'cpu', jax.local_device_count())"
    done = subprocess.run([*python(), "-c", code], capture_output=True, encoding="utf-8", errors="replace", check=False)
    if done.returncode:
        raise UserError(f"JAX does not start: {done.stderr.strip().splitlines()[-1]}")
    is_gpu, count = done.stdout.split()[-2:]
    return ("gpu", int(count)) if is_gpu == "True" else ("cpu", 1)


def only_device(device: int) -> dict[str, str]:
    """The environment variable that restricts a child process to one GPU.

    Args:
        device: index among the GPUs that this process sees.
    """
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return {"CUDA_VISIBLE_DEVICES": visible[device] if visible else str(device)}


def default_device() -> jax.Device:
    """The device of this process on which JAX runs programs by default.

    Its `id` counts the devices of all processes. Its `local_hardware_id` counts the GPUs that this process sees.
    """
    chosen = jax.config.jax_default_device  # type: ignore[attr-defined]
    if isinstance(chosen, str):  # the name of a platform
        return jax.local_devices(backend=chosen)[0]
    return chosen or jax.local_devices()[0]


def num_bytes(tree: object) -> int:
    """Bytes of a pytree of arrays or of their shapes and dtypes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def device_memory() -> int:
    """Bytes of memory that JAX may allocate on its default device."""
    stats = default_device().memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
