"""Versions of this package and of the packages that its results depend on."""

import importlib.metadata
import platform

__all__ = ["package_versions"]

__version__ = "0.1.0"

_PACKAGES = ("gymnasium", "mujoco", "mujoco-mjx", "warp-lang", "jax", "brax", "numpy")


def package_versions() -> dict[str, str]:
    """Versions by package name, without packages that are not installed."""
    found = {"mjx_walk": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
