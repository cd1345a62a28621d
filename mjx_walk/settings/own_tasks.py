"""Tasks that a command line names as `env.task=FILE.py:CLASS`, or that a saved run names."""

import os
from pathlib import Path

from mjx_walk.envs.registry import (
    BUILT_IN_TASKS,
    is_registered_from,
    register_task_file,
    task_hashes,
)
from mjx_walk.envs.user_files import absolute_source, only_known, source_path
from mjx_walk.settings.trust import remember, require_trusted
from mjx_walk.storage.files import working_folder
from mjx_walk.utils.errors import UserError

__all__ = ["KEY", "find_saved_task", "name_task", "take_task"]

KEY = "env.task"
"""The setting that names a file."""


def name_task(source: str) -> tuple[str, str]:
    """Run a file that the user has named, register its task, and trust the file from now on.

    Args:
        source: `FILE.py:CLASS`; a relative path is relative to the working directory.

    Returns:
        The task's name, and the source with an absolute path.

    Raises:
        UserError: the file or the class is missing or invalid, or the name is taken.
    """
    source = absolute_source(source, working_folder())
    only_known(source_path(source), None)
    name = register_task_file(source)
    remember(source, task_hashes(name), KEY)
    return name, source


def take_task(command_line: list[str]) -> list[str]:
    """Register the task that a command line names, and return the other arguments.

    Raises:
        UserError: as for `name_task`.
    """
    for argument in command_line:
        key, _, source = argument.partition("=")
        if key == KEY:
            name_task(source)
    return [argument for argument in command_line if argument.partition("=")[0] != KEY]


def find_saved_task(name: object, source: str | None, config: Path) -> None:
    """Make sure that the task of a saved configuration is registered. Its file runs only if the user trusts it.

    Args:
        name: of the task.
        source: `FILE.py:CLASS`, or None.
        config: the saved configuration, for messages.

    Raises:
        UserError: the task is neither known nor in a trusted file; the message says what to do.
    """
    if isinstance(name, str) and name in BUILT_IN_TASKS:
        if source:
            raise UserError(f"{config} sets env.task for '{name}', a task of this package; remove env.task from it")
        return
    if not isinstance(name, str) or is_registered_from(name, source):  # another type is refused by the schema
        return
    if not source:
        raise UserError(
            f"the task '{name}' of {config} is not registered; add {KEY}=FILE.py:CLASS to the command, pass "
            "task=CLASS to run or load_run, or call mjx_walk.register_task first"
        )
    require_trusted(source, KEY)
    found = register_task_file(source)
    if found != name:
        raise UserError(f"{config} calls its task '{name}', but {os.path.basename(source)} is '{found}'")
