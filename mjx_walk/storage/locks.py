"""Locks between processes, on files."""

import contextlib
import errno
import fcntl
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from mjx_walk.storage.files import open_to_append
from mjx_walk.utils.errors import UserError

__all__ = ["locked"]

_CANNOT_LOCK = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)


@contextlib.contextmanager
def locked(path: Path, in_use: str) -> Iterator[int]:
    """Context manager that holds a lock on a file, which it creates if it does not exist.

    The lock ends with the last process that holds the file descriptor, however that process ends.

    Args:
        path: of the file, which stays empty.
        in_use: message of the error.

    Yields:
        The file descriptor, for child processes that hold the lock as well.

    Raises:
        UserError: another process, or another part of this one, holds the lock.
        OSError: the file cannot be opened.
    """
    descriptor = open_to_append(path)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UserError(in_use) from error
        except OSError as error:
            if error.errno not in _CANNOT_LOCK:
                raise
            warnings.warn(f"the file system of {path} has no locks; use it from one process at a time", stacklevel=3)
        yield descriptor
    finally:
        os.close(descriptor)
