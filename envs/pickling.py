"""Copies and pickles of tasks. They read a task's files again, which may have changed."""

import logging
from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

from mjx_walk.envs.models import warn_of_changed_sources
from mjx_walk.envs.user_files import changed_file

__all__ = ["ReadFiles", "build_again", "files_of", "warn_of_changed_files"]

_LOGGER = logging.getLogger(__name__)
_Task = TypeVar("_Task")


class ReadFiles(NamedTuple):
    """The files that a task has read."""

    model_file: str
    """Empty for a task without a model."""
    model: dict[str, str]
    """SHA-256 by path relative to the model's folder."""
    reward: dict[str, str]
    """SHA-256 of the reward function's files, by absolute path."""


class _Reader(Protocol):
    """A task. `envs.task` imports this module."""

    model_file: str
    model_sources: dict[str, str]

    @property
    def reward_hashes(self) -> dict[str, str]: ...


def files_of(task: _Reader) -> ReadFiles:
    """The files of a task's model and reward function, as they were read."""
    return ReadFiles(task.model_file, task.model_sources, task.reward_hashes)


def build_again(make: Callable[..., _Task], files: ReadFiles, *arguments: object) -> _Task:
    """Build a task from its pickle, and warn if a file that it reads has changed.

    Args:
        make: the task's class.
        files: what the pickled task had read.
        arguments: of the class.
    """
    task = make(*arguments)
    warn_of_changed_files(files)
    return task


def warn_of_changed_files(files: ReadFiles) -> None:
    """Log a warning for a model or a reward function that is not as it was read.

    Raises:
        UserError: the model file is gone.
    """
    if files.model_file:
        warn_of_changed_sources(files.model_file, files.model)
    changed = changed_file(files.reward)
    if changed:
        _LOGGER.warning("%s has changed since it was loaded; it is used as it is now", changed)
