"""Reward functions and tasks from Python files, and the helper modules beside them."""

import ast
import hashlib
import importlib.abc
import importlib.machinery
import importlib.util
import itertools
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from mjx_walk.envs.imported_files import INSTALLED, NEVER_HELPERS, imported_files, module_file
from mjx_walk.storage.files import user_path
from mjx_walk.utils.errors import UserError

__all__ = [
    "UserFile",
    "absolute_source",
    "changed_file",
    "load_from_file",
    "load_reward_function",
    "only_known",
    "source_path",
]

_NUMBERS = itertools.count()
_PREFIX = "_mjx_walk_user_file_"
"""Start of the names in `sys.modules` of the user's files themselves."""

_known: dict[Path, Mapping[str, str]] = {}
"""The SHA-256 of all files that a user's file may run, by the path of that file. Others may run any."""


def source_path(source: str) -> Path:
    """Absolute path of the file in `PATH.py:FUNCTION`."""
    return Path(os.path.abspath(user_path(source.rpartition(":")[0] or ".")))


def absolute_source(source: str, folder: Path) -> str:
    """`PATH.py:FUNCTION` with an absolute path.

    Args:
        source: `PATH.py:FUNCTION`.
        folder: what a relative path is relative to.
    """
    path, colon, name = source.rpartition(":")
    return f"{os.path.abspath(folder / user_path(path or '.'))}:{name}" if colon else source


def changed_file(hashes: Mapping[str, str]) -> str | None:
    """The first file, if any, that is gone or has another SHA-256 than the given one.

    Args:
        hashes: SHA-256 by absolute path.
    """
    for path, expected in hashes.items():
        if not Path(path).is_file() or hashlib.sha256(Path(path).read_bytes()).hexdigest() != expected:
            return path
    return None


def only_known(path: Path, hashes: Mapping[str, str] | None) -> None:
    """Restrict what a user's file may run in this process.

    Args:
        path: of the file.
        hashes: SHA-256 of that file and its helpers, by absolute path; None removes the restriction.
    """
    _known.pop(path, None)
    if hashes is not None:
        _known[path] = hashes


class UserFile:
    """A function or class of a Python file. Modules beside the file are importable while it loads and while it runs.

    Its modules come from the source only: a file in `__pycache__` is never run. Helpers have their usual names, but
    leave `sys.modules` afterwards, so that another file's helper of the same name is another module.
    """

    def __init__(self, path: Path, name: str, kind: str = "function"):
        """
        Args:
            path: absolute path of the file.
            name: of the function or class.
            kind: `function` or `class`, for messages.

        Raises:
            Exception: whatever the file raises.
            UserError: it has no such function or class, or may not run a file.
        """
        self._finder = _Finder(path.parent, _known.get(path))
        module_name = f"{_PREFIX}{next(_NUMBERS)}"  # dataclasses look their module up in sys.modules
        module = importlib.util.module_from_spec(self._finder.spec(module_name, path))
        sys.modules[module_name] = module
        try:
            with self._finder:
                self._finder.exec_module(module)
            value = vars(module).get(name)
            if not callable(value):
                raise UserError(f"'{path}' has no {kind} '{name}'")
        except BaseException:
            del sys.modules[module_name]
            raise
        self.value: Any = value
        """The function or class. A function is called with `__call__`, which makes the helpers importable."""

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        with self._finder:
            return self.value(*arguments)

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of the files that ran so far, and of those that they may import later, by absolute path."""
        return dict(self._finder.hashes)


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports the modules and packages of one folder from their source, inside a `with` block."""

    def __init__(self, folder: Path, known: Mapping[str, str] | None):
        """
        Args:
            folder: the folder.
            known: SHA-256 of the files that may run, by absolute path; None for any.
        """
        self.hashes: dict[str, str] = {}
        """SHA-256 of the files that ran or that those import anywhere, as in a function; by absolute path."""
        self._folder = folder
        self._known = known
        self._tops: set[str] = set()
        self._loaded: dict[str, ModuleType] = {}
        self._hidden: dict[str, ModuleType] = {}

    def __enter__(self) -> None:
        names = {path.stem for path in self._folder.glob("*.py")}
        names |= {path.parent.name for path in self._folder.glob("*/__init__.py")}
        names -= NEVER_HELPERS
        same = {name: module for name, module in sys.modules.items() if name.partition(".")[0] in names}
        self._hidden = {name: module for name, module in same.items() if self._is_another_users(module)}
        for name in self._hidden:
            del sys.modules[name]
        sys.modules.update(self._loaded)
        sys.meta_path.insert(0, self)

    def __exit__(self, *_: object) -> None:
        sys.meta_path.remove(self)
        for name in self._loaded:
            sys.modules.pop(name, None)
        sys.modules.update(self._hidden)

    def _is_another_users(self, module: ModuleType) -> bool:
        """Whether a module is neither of this folder nor installed."""
        file = Path(getattr(module, "__file__", None) or "")
        return not (file.is_relative_to(self._folder) or {*INSTALLED} & {*file.parts})

    def spec(self, name: str, path: Path) -> importlib.machinery.ModuleSpec:
        """A module's spec."""
        places = [str(path.parent)] if path.name == "__init__.py" else None
        spec = importlib.util.spec_from_file_location(name, path, loader=self, submodule_search_locations=places)
        assert spec
        return spec

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The spec of a helper. None for the standard library, this package, and what is not in the folder."""
        top, dot, _ = name.partition(".")
        if top in NEVER_HELPERS or (dot and top not in self._tops):
            return None
        file = module_file(self._folder.joinpath(*name.split(".")))
        if file is None:
            return None
        self._tops.add(top)
        return self.spec(name, file)

    def exec_module(self, module: ModuleType) -> None:
        """Run a module.

        Raises:
            UserError: the file is not among the known ones.
        """
        file = str(module.__file__)
        source = Path(file).read_bytes()
        found = hashlib.sha256(source).hexdigest()
        if self._known is not None and self._known.get(file) != found:
            raise UserError(f"{file} is new or has changed since you named it; to run it, add this to the command line")
        self.hashes[file] = found
        exec(compile(source, file, "exec", dont_inherit=True), vars(module))
        self._hash_imports(Path(file), source)  # not before, since it may extend sys.path
        if not module.__name__.startswith(_PREFIX):
            self._loaded[module.__name__] = module

    def _hash_imports(self, file: Path, source: bytes) -> None:
        """Hash the helpers that a file imports anywhere, and theirs."""
        for helper in imported_files(file, source, self._folder):
            if str(helper) not in self.hashes:
                content = helper.read_bytes()
                self.hashes[str(helper)] = hashlib.sha256(content).hexdigest()
                self._hash_imports(helper, content)


def load_reward_function(source: str) -> UserFile:
    """Load a reward function from a Python file.

    Args:
        source: `PATH.py:FUNCTION`.

    Raises:
        UserError: the file or the function does not exist, or the file raises an exception.
    """
    return load_from_file("env.reward_function", source, "FUNCTION")


def load_from_file(key: str, source: str, kind: str) -> UserFile:
    """Load a function or class from a Python file.

    Args:
        key: the setting that names it, for messages.
        source: `PATH.py:NAME`.
        kind: what NAME is, `FUNCTION` or `CLASS`.

    Raises:
        UserError: the file or the name does not exist, or the file raises an exception.
    """
    path, name = source_path(source), source.rpartition(":")[2]
    problem = f"{key}={source}: "
    unnamed = source.rstrip(":")
    if unnamed.endswith(".py") and user_path(unnamed).is_file():
        raise UserError(f"{problem}it names no {kind.lower()}; write {unnamed}:{kind}{_defined_in(unnamed, kind)}")
    if not path.is_file():
        given = source.rpartition(":")[0] or source
        raise UserError(f"{problem}no file '{given}'; write PATH.py:{kind}")
    if path.suffix != ".py":
        raise UserError(f"{problem}'{path}' is not a Python file; write PATH.py:{kind}")
    try:
        return UserFile(path, name, kind.lower())
    except UserError as error:
        defined = "" if str(error).startswith(f"{path} is new") else _defined_in(path, kind)
        raise UserError(f"{problem}{error}{defined}") from error
    except (Exception, SystemExit) as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        raise UserError(f"{problem}{type(error).__name__}: {reason}") from error


def _defined_in(path: str | Path, kind: str) -> str:
    """Names of the functions or classes of a Python file, for messages; the file is read and not run."""
    wanted = ast.ClassDef if kind == "CLASS" else ast.FunctionDef
    try:
        body = ast.parse(user_path(path).read_bytes()).body
    except (OSError, SyntaxError, ValueError, RecursionError):
        return ""
    names = [node.name for node in body if isinstance(node, wanted) and not node.name.startswith("_")]
    return f"; it defines: {', '.join(names)}" if names else ""
