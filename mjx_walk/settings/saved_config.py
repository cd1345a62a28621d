"""The configuration of a run on disk: its `config.yaml`, the copies in its checkpoints, and which of them counts."""

import contextlib
import dataclasses
import operator
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypeVar

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.settings.config import Config, flatten, to_config
from mjx_walk.settings.own_tasks import find_saved_task
from mjx_walk.settings.renamed import under_present_names
from mjx_walk.storage.files import write_text
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.saved_yaml import read_yaml
from mjx_walk.utils.errors import UserError, first_line
from mjx_walk.utils.setting_fields import Dataclass

__all__ = [
    "MAY_DIFFER",
    "as_yaml",
    "config_of",
    "differences",
    "differing_values",
    "in_short",
    "name_same_file",
    "read_algorithm",
    "read_config",
    "read_saved_config",
    "save_config",
    "with_setting",
]

MAY_DIFFER = (
    *("run_dir", "resume", "total_steps", "algo.schedule_steps"),
    *("wandb_project", "evaluation.films", "profile_calls", "stop_at_return"),
)
"""Settings that may change when a run is resumed."""
_LENGTHS = ("total_steps", "algo.schedule_steps")
"""Those of them that change what is learned."""
_FILES = ("env.xml_file", "env.reward_function", "env.task")
"""Settings that name files, which may move."""
_CHOOSE_RECIPE = ("env.name", "algo.name", "hardware")
"""Settings that choose a recipe, from which many others follow."""
_MOST_NAMED = 5
"""Most differences that a message names."""


def as_yaml(config: Config) -> str:
    """A configuration as the text of a `config.yaml`."""
    return OmegaConf.to_yaml(OmegaConf.structured(config))


def config_of(text: str, path: Path) -> Config:
    """The configuration of a text that `as_yaml` wrote.

    Args:
        text: the content of a `config.yaml`.
        path: for messages.

    Raises:
        UserError: its task or its algorithm is not registered, or it names code that the user does not trust.
    """
    return _parse(DictConfig(OmegaConf.create(text)), path)


def save_config(config: Config, path: Path) -> None:
    """Write a configuration as YAML."""
    write_text(path, as_yaml(config))


def read_config(path: Path) -> Config:
    """Read a configuration that `save_config` wrote, under the present or the former names of its settings.

    Raises:
        UserError: the file is not a configuration that this version reads, or it names code that the user does not
            trust.
    """
    return _parse(_read(path), path)


def read_saved_config(folder: RunFolder) -> Config:
    """The configuration of a run.

    The copy in the newest checkpoint counts, since the checkpoint was trained with it. Settings that may change, and
    the folders of files that the configuration names, come from `config.yaml`, if that can be read.

    Raises:
        UserError: there is no configuration that this version reads, or it names code that the user does not trust.
    """
    copy = folder.config_copy()
    if copy is None:
        return read_config(folder.config)
    trained = _read(copy)
    name = folder.config if folder.config.is_file() else copy  # for messages about code that is not trusted
    try:
        file = _read(folder.config)
        for key in _FILES:
            if name_same_file(OmegaConf.select(trained, key), OmegaConf.select(file, key)):
                OmegaConf.update(trained, key, OmegaConf.select(file, key))
        present = _parse(file, folder.config)
    except UserError as error:
        config = _parse(trained, name)
        warnings.warn(f"{error}; the copy in {copy} is used", stacklevel=2)
        return config
    config = _parse(trained, name)
    _warn_of_edits(config, present, folder.config, copy)
    for key in MAY_DIFFER:
        config = with_setting(config, key, operator.attrgetter(key)(present))
    return config


def read_algorithm(folder: RunFolder) -> dict[str, object]:
    """The settings of a run's algorithm, and its `name`. Neither its task nor its reward function needs to be known.

    Raises:
        UserError: there is no configuration that this version reads.
    """
    path = folder.config_copy() or folder.config
    saved = _read(path)
    with _errors_that_name(path):
        settings: dict[str, object] = dict(OmegaConf.to_object(saved.algo))  # type: ignore[arg-type]
        return {"name": str(settings.pop("name")), **settings}


def _warn_of_edits(trained: Config, present: Config, file: Path, copy: Path) -> None:
    """Name the settings of a `config.yaml` that differ from those of the training."""
    edited = differences(trained, present)
    if edited:
        warnings.warn(f"{file} differs from the checkpoint: {in_short(edited)}; {copy} is used", stacklevel=3)
    others = tuple(key for key in flatten(present) if key not in _LENGTHS)
    lengths = differences(trained, present, besides=others)
    if lengths:
        warnings.warn(f"{file} changes the run's length: {'; '.join(lengths)}; {file.name} is used", stacklevel=3)


def _read(path: Path) -> DictConfig:
    """The nodes of a saved configuration, under the present names of the settings."""
    with _errors_that_name(path):
        try:
            return under_present_names(read_yaml(path))
        except OSError as error:
            raise UserError(f"cannot read {path}: {error.strerror}") from error


def _parse(saved: DictConfig, path: Path) -> Config:
    with _errors_that_name(path):
        find_saved_task(saved.env.name, saved.env.get("task"), path)
        if saved.algo.name not in ALGORITHMS:
            raise UserError(f"the algorithm '{saved.algo.name}' of {path} is not registered; {_HOW_TO_REGISTER}")
        schema = OmegaConf.structured(Config(env=TASKS[saved.env.name][1](), algo=ALGORITHMS[saved.algo.name][1]()))
        return to_config(OmegaConf.merge(schema, saved))


_HOW_TO_REGISTER = "call mjx_walk.register_algorithm before load_run, or in the FILE.py of env.task=FILE.py:CLASS"
_UNREADABLE = (
    *(LookupError, AttributeError, TypeError, ValueError, RecursionError),
    *(yaml.YAMLError, OmegaConfBaseException),
)


@contextlib.contextmanager
def _errors_that_name(path: Path) -> Iterator[None]:
    """Context manager whose errors name the file that is not a saved configuration, and what is wrong in it."""
    try:
        yield
    except UserError:
        raise
    except _UNREADABLE as error:
        reason = first_line(error)
        if isinstance(error, UnicodeDecodeError):
            reason = "it is not a text in UTF-8"
        elif getattr(error, "full_key", None) and "key" not in reason.lower():
            reason = f"{error.full_key}: {reason}"  # type: ignore[union-attr]
        advice = "correct it, or restore the file from a backup"
        raise UserError(f"{path} is not a configuration of this version: {reason}; {advice}") from error


def differences(saved: Config, config: Config, besides: tuple[str, ...] = MAY_DIFFER) -> list[str]:
    """The settings in which two configurations differ, with both values, for messages.

    Args:
        saved: the former configuration.
        config: the present one.
        besides: keys to ignore.
    """
    return differing_values(flatten(saved), flatten(config), besides)


def differing_values(old: Mapping[str, object], new: Mapping[str, object], besides: tuple[str, ...] = ()) -> list[str]:
    """The keys whose values differ, with both values, for messages. A missing value is None.

    Args:
        old: former values by their full keys.
        new: present ones.
        besides: keys to ignore.
    """
    return [
        f"{key} (was {old.get(key)}, now {new.get(key)})"
        for key in sorted(old.keys() | new.keys())
        if key not in besides and old.get(key) != new.get(key)
    ]


def in_short(differing: list[str]) -> str:
    """One line that names a few differences, and counts the others.

    If there are many, it names those that choose the recipe: the others mostly follow from them.

    Args:
        differing: see `differences`.
    """
    choosing = [text for text in differing if text.partition(" ")[0] in _CHOOSE_RECIPE]
    named = differing if len(differing) <= _MOST_NAMED else choosing or differing[:_MOST_NAMED]
    num_others = len(differing) - len(named)
    return "; ".join([*named, *([f"and {num_others} more"] if num_others else [])])


def name_same_file(old: object, new: object) -> bool:
    """Whether two paths, or two `PATH.py:NAME`, differ at most in the folder of the file."""
    return isinstance(old, str) and isinstance(new, str) and Path(old).name == Path(new).name


_Settings = TypeVar("_Settings", bound=Dataclass)


def with_setting(settings: _Settings, key: str, value: object) -> _Settings:
    """Replace a value of nested dataclasses by its key, such as `evaluation.films`."""
    name, _, rest = key.partition(".")
    own = with_setting(getattr(settings, name), rest, value) if rest else value
    return dataclasses.replace(settings, **{name: own})
