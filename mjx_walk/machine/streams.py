"""The standard streams of a process that was started with some of them closed. This module does not import JAX."""

import contextlib
import os
from collections.abc import Iterator

__all__ = ["open_standard_streams", "with_standard_streams"]


def open_standard_streams() -> list[int]:
    """Open the null device in place of standard streams that are closed. Returns their file descriptors.

    Otherwise the next files that are opened would take these numbers, and receive what C libraries print.
    """
    closed = []
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
            os.set_inheritable(number, True)
            closed.append(number)
    return closed


@contextlib.contextmanager
def with_standard_streams() -> Iterator[bool]:
    """Context manager in which all standard streams are open. Yields whether some of them are closed otherwise."""
    opened = open_standard_streams()
    try:
        yield bool(opened)
    finally:
        for number in opened:
            os.close(number)
