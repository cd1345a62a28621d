"""Modules of this package as child processes."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

PYTHON = [sys.executable, *(["-P"] if sys.flags.safe_path else [])]
"""The command of this interpreter. With `-P` it imports nothing from the working directory."""
_ROOT = Path(__file__).parents[2]


def start_module(name: str, *arguments: str, env: dict[str, str] | None = None, **options: Any) -> subprocess.Popen:
    """Start `python -m mjx_walk.NAME ARGUMENTS` in a new session, so that Ctrl-C reaches only the parent.

    The child imports the same copy of this package as its parent, and modules of the working directory only if the
    parent does (`python -P`).

    Args:
        name: module name without the package.
        arguments: its command line.
        env: environment variables to add to those of this process.
        options: further arguments of `subprocess.Popen`.
    """
    # An empty part would stand for the working directory.
    paths = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [*PYTHON, "-m", f"mjx_walk.{name}", *arguments],
        env=os.environ | {"PYTHONPATH": paths} | (env or {}),
        start_new_session=True,
        **options,
    )
