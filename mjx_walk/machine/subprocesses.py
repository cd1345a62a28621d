"""Modules of this package as child processes."""

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

__all__ = ["end_with_parent", "python", "start_module", "with_parent"]

_ROOT = Path(__file__).parents[2]
_ENDED_BY_PARENT = "MJX_WALK_ENDED_BY"
"""Environment variable of a child process that must not outlive its parent: the parent's process id."""
_PR_SET_PDEATHSIG = 1
"""From Linux's `prctl.h`."""


def with_parent() -> dict[str, str]:
    """For `env` of `start_module`: the child ends when this process does, even by SIGKILL (Linux only)."""
    return {_ENDED_BY_PARENT: str(os.getpid())}


def end_with_parent() -> None:
    """Receive SIGTERM when the parent ends, if it has asked for that."""
    parent = os.environ.pop(_ENDED_BY_PARENT, None)  # for this process, not for its own children
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # it has ended already
        signal.raise_signal(signal.SIGTERM)


def python() -> list[str]:
    """The command of this interpreter. A child imports modules of the working directory only if this process does.

    With `-m` or `-c` and without `-P` it always would, and run what a downloaded folder has there.
    """
    try:
        here = os.getcwd()
    except FileNotFoundError:  # it was removed
        return [sys.executable, "-P"]
    imports_from_here = any(os.path.realpath(path) == here for path in sys.path)
    return [sys.executable, *([] if imports_from_here else ["-P"])]


def start_module(name: str, *arguments: str, env: dict[str, str] | None = None, **options: Any) -> subprocess.Popen:
    """Start `python -m mjx_walk.NAME ARGUMENTS` in a new session, so that Ctrl-C reaches only the parent.

    The child imports the same copy of this package as its parent.

    Args:
        name: module name without the package.
        arguments: its command line.
        env: environment variables to add to those of this process.
        options: further arguments of `subprocess.Popen`.
    """
    # An empty part would stand for the working directory.
    paths = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [*python(), "-m", f"mjx_walk.{name}", *arguments],
        env=os.environ | {"PYTHONPATH": paths} | (env or {}),
        start_new_session=True,
        **options,
    )
