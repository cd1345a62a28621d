"""Versions of this package and of the packages that its results depend on."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

__all__ = ["git_commit", "package_versions"]

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


def git_commit() -> str | None:
    """Commit of the clone that this package runs from, with `-dirty` if files of it have changed.

    None for an installed package, and where git does not know.
    """
    clone = Path(__file__).parents[2]
    if not (clone / ".git").exists():  # the package may lie in the clone of another project
        return None
    command = ["git", "-C", str(clone), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(
            command,
            env=os.environ | {"GIT_OPTIONAL_LOCKS": "0"},
            capture_output=True,
            text=True,
            encoding="utf-8",
            check=False,
        )
    except OSError:  # git is not installed
        return None
    return done.stdout.strip() if done.returncode == 0 else None
