"""Work that an engine does in the background while its programs are compiled."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextvars import ContextVar

__all__ = ["Preparation", "nothing_runs"]

_nothing_runs: ContextVar[bool] = ContextVar("nothing_runs", default=False)


@contextlib.contextmanager
def nothing_runs() -> Iterator[None]:
    """Inside, programs are only traced. No engine needs to be ready for that."""
    token = _nothing_runs.set(True)
    try:
        yield
    finally:
        _nothing_runs.reset(token)


class Preparation:
    """Work that must end before a program of the engine runs."""

    def __init__(self, begin: Callable[[], Sequence[Future]] = tuple):
        """
        Args:
            begin: begins the work. By default there is none.
        """
        self._begin = begin
        self._futures: Sequence[Future] = ()

    def begin(self) -> None:
        """Begin in the background, unless it has begun."""
        if not self._futures or any(future.cancelled() for future in self._futures):
            self._futures = self._begin()

    def wait(self) -> None:
        """Wait for what has begun.

        Raises:
            Exception: the work failed.
        """
        try:
            for future in self._futures:
                future.result()
        except BaseException:
            self.cancel()
            raise

    def before_trace(self) -> None:
        """Begin and wait, since the program may run without further notice, unless `nothing_runs`."""
        if not _nothing_runs.get():
            self.begin()
            self.wait()

    def cancel(self) -> None:
        """Give up work that has not begun."""
        for future in self._futures:
            future.cancel()
