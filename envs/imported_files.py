"""The files that a Python file imports, found without running it."""

import ast
import importlib.machinery
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

__all__ = ["INSTALLED", "NEVER_HELPERS", "imported_files", "module_file"]

NEVER_HELPERS = sys.stdlib_module_names | {"mjx_walk"}
"""Top-level modules that are no helpers of a user, even if a file beside has such a name."""
INSTALLED = ("site-packages", "dist-packages")
"""Folders of installed modules."""


def imported_files(file: Path, source: bytes, folder: Path) -> Iterator[Path]:
    """Files that a Python file imports, of its folder and of others on `sys.path`. It is read and not run."""
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError, RecursionError):
        return  # running it reports it
    for node in nodes:
        start = folder
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = file.parents[node.level - 1] if node.level else folder
            names = [".".join(filter(None, (node.module, alias.name))) for alias in node.names]
        else:
            continue
        is_relative = isinstance(node, ast.ImportFrom) and node.level > 0
        for name in names:
            if is_relative:
                yield from _files_of(start, name)
            elif name.partition(".")[0] not in NEVER_HELPERS:
                yield from list(_files_of(folder, name)) or _files_on_path(name)


def _files_of(folder: Path, name: str) -> Iterator[Path]:
    """Files that run when a module of a folder is imported: its packages, and its own."""
    place = folder
    for part in name.split("."):
        place /= part
        found = module_file(place)
        if found is None:
            return
        yield found


def module_file(place: Path) -> Path | None:
    """The file of a module, given its path without an ending: a package's `__init__.py`, or `NAME.py`."""
    files = (place / "__init__.py", place.with_name(f"{place.name}.py"))
    return next((file for file in files if file.is_file()), None)


def _files_on_path(name: str) -> Iterator[Path]:
    """Files that run when a module on `sys.path` is imported, unless it is installed."""
    places: Sequence[str] | None = None
    parts = name.split(".")
    for end in range(1, len(parts) + 1):
        spec = importlib.machinery.PathFinder.find_spec(".".join(parts[:end]), places)
        file = Path(os.path.abspath(spec.origin)) if spec and spec.origin else None
        if spec is None or (file and {*INSTALLED} & {*file.parts}):
            return
        if file and file.suffix == ".py":
            yield file
        if spec.submodule_search_locations is None:
            return
        places = list(spec.submodule_search_locations)
