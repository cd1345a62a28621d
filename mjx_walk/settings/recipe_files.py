"""Recipes as nodes of Hydra: files of the user, `recipe=PATH`, and recipes of this package without a file."""

import hashlib
import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.settings.overrides import named_values
from mjx_walk.settings.recipes import CONFIG_DIR, HARDWARE, fallback, has_file
from mjx_walk.settings.schema import leaves
from mjx_walk.storage.files import read_bytes, user_path, working_folder
from mjx_walk.utils.errors import UserError, first_line

__all__ = ["read_recipe", "recipe_file", "recipe_settings", "with_paths", "with_stored_recipes"]

_RECIPES = Path(CONFIG_DIR) / "recipe"
_SUFFIXES = (".yaml", ".yml")
_MAX_BYTES = 1_000_000
_SELF = "_self_"
_paths: dict[str, Path] = {}
"""Recipe files by the names of their nodes."""


def recipe_file(name: str, folder: Path | None = None) -> Path | None:
    """The file of a recipe. None for this package's recipes, and for a name that neither they nor a file has.

    Args:
        name: value of `recipe=`; the ending `.yaml` may be left out.
        folder: what a relative path is relative to, by default the working directory.

    Raises:
        UserError: a path that leads to no file.
    """
    if _shipped_file(name):
        return None
    path = Path(os.path.abspath((folder or working_folder()) / user_path(name)))
    for file in (path, path.with_name(f"{path.name}.yaml")):
        if file.is_file():
            return file
    if name.startswith((".", "/", "~")) or path.suffix in _SUFFIXES:
        found = f"'{path}' is a folder" if path.is_dir() else f"no recipe file '{path}'"
        raise UserError(f"{found}; give the path of a YAML file, or the name of a recipe such as cpu/humanoid_ppo")
    return None


def _shipped_file(name: str) -> Path | None:
    """The file of a recipe of this package, which may be the one that it falls back to. None for other names."""
    name = name.removesuffix(".yaml")
    parent = fallback(name)
    is_shipped = not name.startswith((".", "/", "~")) and (has_file(name) or parent is not None)
    return _RECIPES / f"{parent or name}.yaml" if is_shipped else None


def with_stored_recipes(overrides: list[Override], store: ConfigStore) -> list[str]:
    """Overrides in which recipe files have the names under which Hydra finds them in the store.

    Recipes of this package without a file are stored, too.

    Args:
        overrides: the command line, as `read_overrides` returns it.
        store: Hydra's store; the files are read into it.

    Raises:
        UserError: a file is missing, is no recipe, or inherits from one that is not.
    """
    for name in _shipped_names(overrides):
        parent = fallback(name)
        if parent is not None:
            defaults = [f"/recipe/{parent}", _SELF] if parent else [_SELF]
            group, _, stem = name.partition("/")
            store.store(group=f"recipe/{group}", name=stem, node={"defaults": defaults}, package="_global_")
    return [_with_stored_recipe(override, store) for override in overrides]


def _shipped_names(overrides: list[Override]) -> list[str]:
    """Names of recipes of this package for which overrides ask, with several values in a sweep."""
    given = {override.key_or_group: named_values(override) for override in overrides}
    if given.get("recipe"):
        return given["recipe"]
    all_values = {"hardware": HARDWARE, "env": TASKS, "algo": ALGORITHMS}
    usual = {"env": ["humanoid"], "algo": ["ppo"]}
    sizes, envs, algos = (given.get(key, usual.get(key)) or list(values) for key, values in all_values.items())
    return [f"{size}/{env}_{algo}" for size, env, algo in itertools.product(sizes, envs, algos)]


def with_paths(message: str) -> str:
    """A message of Hydra's with the paths of recipe files in place of the names of their nodes."""
    for name, path in _paths.items():
        message = message.replace(f"recipe/{name}", str(path)).replace(name, str(path))
    return message


def _with_stored_recipe(override: Override, store: ConfigStore) -> str:
    names = []
    for value in named_values(override) if override.key_or_group == "recipe" else ():
        file = recipe_file(value)
        names.append(_store(file, store, ()) if file else value)
    return f"recipe={','.join(names)}" if names else str(override.input_line)


def _store(path: Path, store: ConfigStore, above: tuple[Path, ...]) -> str:
    """Store a recipe file and those that it inherits from. Returns the name of its node."""
    if path in above:
        raise UserError(f"the recipe {path} inherits from itself; correct the defaults of {above[-1]}")
    node = read_recipe(path)
    if "defaults" in node:
        entries = sorted(_defaults(node, path), key=_is_override)  # Hydra wants them last
        node.defaults = [_stored_default(entry, path, store, (*above, path)) for entry in entries]
    name = f"own_{hashlib.sha256(os.fsencode(path)).hexdigest()[:16]}"
    _paths[name] = path
    store.store(group="recipe", name=name, node=node, package="_global_")
    return name


def _stored_default(entry: object, path: Path, store: ConfigStore, above: tuple[Path, ...]) -> object:
    """An entry of a defaults list, under the name of its node if it is a file."""
    file = _inherited_file(entry, path)
    return _store(file, store, above) if file else entry


def _is_override(entry: object) -> bool:
    return isinstance(entry, dict) and any(str(key).startswith("override ") for key in entry)


def _inherited_file(entry: object, path: Path) -> Path | None:
    """The file that an entry of a defaults list names. None for Hydra's keywords.

    Raises:
        UserError: the entry names neither a file nor a recipe.
    """
    if not isinstance(entry, str) or entry == _SELF:
        return None
    file = _shipped_file(entry.removeprefix("/recipe/")) or recipe_file(entry, path.parent)
    if file is None:
        raise UserError(f"{path} inherits from '{entry}', which is neither a file beside it nor a recipe")
    return file


def _defaults(node: DictConfig, path: Path) -> list[object]:
    entries = node.defaults
    if not isinstance(entries, ListConfig):
        raise UserError(f"{path}: its defaults are not a list; write '- NAME' in a line for each")
    return OmegaConf.to_container(entries)  # type: ignore[return-value]


def read_recipe(path: Path) -> DictConfig:
    """Read a recipe file.

    Raises:
        UserError: it cannot be read, is not YAML, or has no keys.
    """
    try:
        node = OmegaConf.create(read_bytes(path, _MAX_BYTES).decode())
    except OSError as error:
        raise UserError(f"cannot read the recipe {path}: {error.strerror}") from error
    except yaml.MarkedYAMLError as error:
        raise UserError(f"the recipe {path} is not valid YAML: {first_line(error)}") from error
    except (ValueError, RecursionError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise UserError(f"the recipe {path} cannot be read: {first_line(error)}") from error
    if not isinstance(node, DictConfig) or not node or any(not isinstance(key, str) for key in node):
        raise UserError(f"the recipe {path} has no settings; write 'KEY: VALUE' in a line for each")
    return node


def recipe_settings(path: Path) -> Iterator[tuple[Path, str, Any]]:
    """The settings of a recipe file and of the files that it inherits from: file, full key, value.

    A choice such as `override /env: ant` has the key `/env`.
    """
    node = read_recipe(path)
    for entry in _defaults(node, path) if "defaults" in node else ():
        file = _inherited_file(entry, path)
        if file:
            yield from recipe_settings(file)
        elif isinstance(entry, dict):
            yield from ((path, f"/{key.rpartition('/')[2]}", value) for key, value in entry.items())
    for key, value in leaves(OmegaConf.to_container(node)):
        if key != "defaults":
            yield path, key, value
