"""Modules of this package in processes of their own."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).parents[2]


def start_module(name: str, *arguments: str, env: dict[str, str] | None = None, **options: Any) -> subprocess.Popen:
    """Start `python -m mjx_walk.NAME ARGUMENTS`, which finds this package wherever it lies; Ctrl-C is for the parent.

    Args:
        name: of the module.
        arguments: its command line.
        env: variables beside those of this process.
        options: further ones of `subprocess.Popen`.
    """
    paths = os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", f"mjx_walk.{name}", *arguments],
        env=os.environ | {"PYTHONPATH": paths} | (env or {}),
        start_new_session=True,
        **options,
    )
