"""Copies and pickles of tasks. They read a task's files again, which may have changed."""

import logging
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from mjx_walk.envs.models import warn_of_changed_sources
from mjx_walk.envs.user_files import changed_file

__all__ = ["ReadFiles", "build_again", "warn_of_changed_files"]

_LOGGER = logging.getLogger(__name__)
_Task = TypeVar("_Task")


class ReadFiles(NamedTuple):
    """The files that a task has read."""

    model_file: str
    model: dict[str, str]
    """SHA-256 by path relative to the model's folder."""
    reward: dict[str, str]
    """SHA-256 of the reward function's files, by absolute path."""


def build_again(make: Callable[..., _Task], arguments: tuple[object, ...], files: ReadFiles) -> _Task:
    """Build a task from its pickle, and warn if a file that it reads has changed.

    Args:
        make: the task's class.
        arguments: its arguments.
        files: what the pickled task had read.
    """
    task = make(*arguments)
    warn_of_changed_files(files)
    return task


def warn_of_changed_files(files: ReadFiles) -> None:
    """Log a warning for a model or a reward function that is not as it was read.

    Raises:
        UserError: the model file is gone.
    """
    warn_of_changed_sources(files.model_file, files.model)
    changed = changed_file(files.reward)
    if changed:
        _LOGGER.warning("%s has changed since it was loaded; it is used as it is now", changed)
