"""The exceptions for errors that the user can correct."""

import errno
from pathlib import Path

import yaml

from mjx_walk.utils.text import printable

__all__ = ["UnreadableError", "UserError", "failed_read", "first_line"]

_IS_DAMAGE = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, None)


class UserError(ValueError):
    """Invalid input. Commands print its one-line message without a traceback and exit with code 2."""

    def __str__(self) -> str:
        # A file's name, which a message quotes, may hold escape sequences and line breaks.
        return printable(super().__str__())


class UnreadableError(UserError):
    """A file that may be whole, but that cannot be read now."""


def failed_read(folder: Path, error: OSError) -> ValueError:
    """The error for a saved folder of which a file could not be read.

    Args:
        folder: the folder.
        error: what the system says.

    Returns:
        `UnreadableError` if permissions or a failing disk are the cause. Else the folder is damaged.
    """
    reason = error.strerror or str(error)
    if error.errno in _IS_DAMAGE:
        name = f"{Path(error.filename).name}: " if error.filename else ""
        return ValueError(f"{folder} is damaged: {name}{reason}")
    return UnreadableError(f"cannot read {error.filename or folder}: {reason}; once it can be read, try again")


def first_line(error: BaseException) -> str:
    """The first line of an error's text that is not empty. For an error of YAML, the line that is wrong, and how."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        return f"line {error.problem_mark.line + 1}: {error.problem}"
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
