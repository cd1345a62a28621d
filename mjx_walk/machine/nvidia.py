"""The NVIDIA GPU of this machine, its driver, and why JAX or Warp does not use it. Nothing here starts CUDA."""

import ctypes
import dataclasses
import functools
import os
import re
import warnings
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path

import jax

__all__ = ["ROOT", "Machine", "installed_version", "warn_of_unused_gpu", "warp_misfit", "why_unused"]

_CUDA_13_DRIVER = 580
"""Oldest release of the driver for CUDA 13, on Linux."""
_CUDA_12_DRIVER = 525
"""Oldest release of the driver for CUDA 12, on Linux."""

ROOT = Path("/")
"""Folder of `dev`, `proc` and `sys`."""
_NVIDIA = "0x10de"
"""Vendor ID on the PCI bus."""
_DISPLAY = "0x03"
"""Class of graphics cards and accelerators on the PCI bus."""
_HIDING = ("", "-1", "none", "void", "NoDevFiles")
"""Values of `CUDA_VISIBLE_DEVICES` that show no GPU."""


@dataclasses.dataclass(frozen=True)
class Machine:
    """Facts that decide whether a program can use an NVIDIA GPU."""

    has_gpu: bool = False
    """Whether there is a GPU, be it out of reach."""
    has_device_files: bool = False
    """Whether the GPU is within reach. A container that was started without GPUs has none of these files."""
    driver: str | None = None
    """Version of the driver as people know it, such as `535.104.05`, or the newest CUDA that it supports."""
    release: int | None = None
    """Release that the driver is at least: 535, or 580 for any that supports CUDA 13."""

    @classmethod
    def seen(cls, root: Path | None = None, newest_cuda: Callable[[], int | None] | None = None) -> "Machine":
        """Look at files of the system.

        Args:
            root: folder of `dev`, `proc` and `sys`, by default `ROOT`.
            newest_cuda: the newest CUDA version that the driver supports, such as 12020 for 12.2, or None. It is known
                where `proc` shows no version, as in WSL. By default the driver's library is asked.
        """
        root = root or ROOT
        devices = [*(root / "dev").glob("nvidia[0-9]*"), *(root / "dev").glob("nvidiactl")]
        version = _kernel_module(root)
        cuda = (newest_cuda or _newest_cuda)() if devices or (root / "dev" / "dxg").exists() else None
        is_wsl = cuda is not None and not devices  # WSL has its device file for GPUs of all makers
        is_listed = any((root / "proc/driver/nvidia/gpus").glob("*")) or (not devices and _is_on_pci(root))
        release = int(version.partition(".")[0]) if version else None
        if cuda is not None and (release is None or cuda // 1000 >= 13):  # newer libraries for older drivers exist
            release = _CUDA_13_DRIVER if cuda // 1000 >= 13 else _CUDA_12_DRIVER if cuda // 1000 == 12 else 0
            version = version or f"for CUDA {cuda // 1000}.{cuda % 1000 // 10}"
        return cls(bool(devices) or is_wsl or is_listed, bool(devices) or is_wsl, version, release)


def _kernel_module(root: Path) -> str | None:
    """Version of the kernel's module, if it is loaded and shows it."""
    try:
        text = (root / "proc/driver/nvidia/version").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    found = re.search(r"\b\d{3,4}\.\d+(?:\.\d+)*\b", text)
    return found[0] if found else None


def _newest_cuda() -> int | None:
    """The newest CUDA version that the driver's library supports."""
    version = ctypes.c_int()
    try:
        code = ctypes.CDLL("libcuda.so.1").cuDriverGetVersion(ctypes.byref(version))
    except (OSError, AttributeError):
        return None
    return version.value if code == 0 and version.value else None


def _is_on_pci(root: Path) -> bool:
    """Whether there is a graphics card of NVIDIA, with or without a driver."""
    for device in (root / "sys/bus/pci/devices").glob("*"):
        try:
            is_nvidia = (device / "vendor").read_text(encoding="ascii").strip() == _NVIDIA
            if is_nvidia and (device / "class").read_text(encoding="ascii").startswith(_DISPLAY):
                return True
        except (OSError, ValueError):
            continue
    return False


def why_unused(
    machine: Machine, visible: str | None, installed: Mapping[str, str], error: str | None = None
) -> str | None:
    """Why JAX does not use the GPU of a machine, and what to do, in one line. None if there is no GPU.

    Args:
        machine: where JAX uses the CPU although nobody has asked for that.
        visible: value of `CUDA_VISIBLE_DEVICES`, if it is set.
        installed: versions of installed distributions by name, at least those of JAX.
        error: what JAX says of the GPU.
    """
    if not machine.has_gpu:
        return None
    plugins = [number for number in (13, 12) if f"jax-cuda{number}-plugin" in installed]
    if not machine.has_device_files:
        why = _why_out_of_reach(machine)
    elif visible is not None and visible.partition(",")[0].strip() in _HIDING:
        why = f"CUDA_VISIBLE_DEVICES={visible} hides it; unset that variable"
    elif not plugins:
        why = f"JAX's CUDA plugin is not installed; {_what_to_install(machine)}"
    else:
        why = _why_plugin_fails(machine, plugins[0], installed, error, visible)
    return f"this machine has an NVIDIA GPU, but JAX runs on the CPU: {why}"


def _why_out_of_reach(machine: Machine) -> str:
    if machine.driver is None:
        return f"no NVIDIA driver is loaded; install release {_CUDA_13_DRIVER} or later"
    return "this container has no access to it; start it with GPUs, for example docker run --gpus all"


def _what_to_install(machine: Machine) -> str:
    """The `pip install` for the driver of a machine."""
    if machine.release is None:
        return (
            f"pip install 'mjx-walk[cuda]' with driver {_CUDA_13_DRIVER} or later, "
            f"'mjx-walk[cuda12]' with driver {_CUDA_12_DRIVER} or later"
        )
    if machine.release >= _CUDA_13_DRIVER:
        return "pip install 'mjx-walk[cuda]'"
    if machine.release >= _CUDA_12_DRIVER:
        return f"pip install 'mjx-walk[cuda12]', since the driver, {machine.driver}, is older than {_CUDA_13_DRIVER}"
    return f"update the driver, {machine.driver}, to {_CUDA_13_DRIVER} or later, and pip install 'mjx-walk[cuda]'"


def _why_plugin_fails(
    machine: Machine, cuda: int, installed: Mapping[str, str], error: str | None, visible: str | None
) -> str:
    needed = _CUDA_13_DRIVER if cuda == 13 else _CUDA_12_DRIVER
    if machine.release is not None and machine.release < needed:
        why = f"the driver, {machine.driver}, is older than {needed}, which JAX's CUDA {cuda} plugin needs; update it"
        if machine.release < _CUDA_12_DRIVER:
            return why
        return f"{why}, or pip uninstall jax-cuda13-plugin jax-cuda13-pjrt and pip install 'mjx-walk[cuda12]'"
    plugin, jaxlib = installed[f"jax-cuda{cuda}-plugin"], installed.get("jaxlib", "")
    if plugin != jaxlib:
        return f"jax-cuda{cuda}-plugin {plugin} does not fit jaxlib {jaxlib}; pip install 'jax[cuda{cuda}]=={jaxlib}'"
    reason = f" ({' '.join(error.split())[:300]})" if error else ""
    shown = f", CUDA_VISIBLE_DEVICES={visible} names one" if visible else ""
    return (
        f"its CUDA {cuda} plugin does not start{reason}; check that nvidia-smi lists GPUs{shown}, and LD_LIBRARY_PATH "
        f"is unset, then pip install --force-reinstall 'jax[cuda{cuda}]=={jaxlib}'"
    )


@functools.cache
def warn_of_unused_gpu() -> None:
    """Warn once if there is an NVIDIA GPU, JAX runs on the CPU, and the user has not asked for that."""
    if jax.config.jax_platforms or jax.default_backend() != "cpu":  # type: ignore[attr-defined]
        return
    versions = {name: installed_version(name) for name in ("jaxlib", "jax-cuda12-plugin", "jax-cuda13-plugin")}
    installed = {name: version for name, version in versions.items() if version}
    errors = getattr(jax._src.xla_bridge, "_backend_errors", {})
    why = why_unused(Machine.seen(), os.environ.get("CUDA_VISIBLE_DEVICES"), installed, errors.get("cuda"))
    if why:
        warnings.warn(why, stacklevel=3)


def installed_version(distribution: str) -> str | None:
    """Version of an installed distribution; None if it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def warp_misfit(machine: Machine, version: str | None) -> str | None:
    """Why Warp cannot use the GPU of a machine, and what to do. None if it can, or if a version is unknown.

    Args:
        machine: with a GPU.
        version: of `warp-lang`. The wheels on PyPI are built with CUDA 13, and those named `+cu12` with CUDA 12.
    """
    if version is None:
        return None
    needed = _CUDA_12_DRIVER if "+cu12" in version else _CUDA_13_DRIVER
    if machine.release is None or machine.release >= needed:
        return None
    update = f"the NVIDIA driver, {machine.driver}, is older than {needed}, which Warp {version} needs; update it"
    if machine.release < _CUDA_12_DRIVER:
        return update
    return f"{update}, or install the +cu12 wheel of github.com/NVIDIA/warp/releases"
