"""Run-time checks of the shapes and dtypes that jaxtyping annotations state."""

import ast
import importlib.machinery
import sys
from typing import Any

import beartype
import jaxtyping
import pytest

CHECKED_ROOMS = ("mjx_walk.algos", "mjx_walk.common")
"""In these packages, every call of every test is checked."""
_DECORATOR = '__import__("jaxtyping").jaxtyped(typechecker=__import__("beartype").beartype)'


def check_shapes(monkeypatch: pytest.MonkeyPatch, owner: Any, *names: str) -> None:
    """Check the annotations of a class's or module's functions in every call, until the test ends."""
    for name in names:
        checked = jaxtyping.jaxtyped(getattr(owner, name), typechecker=beartype.beartype)
        monkeypatch.setattr(owner, name, checked)


def check_rooms() -> None:
    """Check the functions of `CHECKED_ROOMS` in every call. Call it before these packages are imported."""
    sys.meta_path.insert(0, _Finder())


class _Finder:
    def find_spec(self, name, path=None, target=None):
        if not any(f"{name}.".startswith(f"{room}.") for room in CHECKED_ROOMS):
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None:
            spec.loader = CheckedLoader(name, spec.origin)
        return spec


class CheckedLoader(importlib.machinery.SourceFileLoader):
    """Loads a module whose functions with jaxtyping annotations are checked at every call; classes stay as they are.

    jaxtyping's own import hook also decorates dataclasses, but JAX fills states with shapes, axes and `None`, too.
    """

    def path_stats(self, path):
        raise OSError  # neither reads nor writes bytecode

    def source_to_code(self, data, path, *, _optimize=-1):
        tree = ast.parse(data)
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == "jaxtyping"]
        names = {alias.name for node in imports for alias in node.names}
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and _annotation_names(node) & names:
                decorator = ast.parse(_DECORATOR, mode="eval").body
                # The innermost one: `property` and `abstractmethod` apply to the checked function.
                node.decorator_list.append(ast.copy_location(decorator, node))
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True, optimize=_optimize)


def _annotation_names(function: ast.FunctionDef) -> set[str]:
    every = function.args
    arguments = [*every.posonlyargs, *every.args, *every.kwonlyargs, every.vararg, every.kwarg]
    hints = [argument.annotation for argument in arguments if argument] + [function.returns]
    return {node.id for hint in hints if hint for node in ast.walk(hint) if isinstance(node, ast.Name)}
