"""Signal handling: a run stops after its current call, and later stages stop as after Ctrl-C."""

import contextlib
import logging
import signal
import threading
from collections.abc import Callable, Iterator

__all__ = ["Interrupt", "Stopped", "as_by_ctrl_c", "exit_code"]

_PROGRESS = logging.getLogger("mjx_walk.progress")
_FROM_SCHEDULERS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGUSR1") if hasattr(signal, name))


class Interrupt:
    """Context manager that records Ctrl-C, SIGTERM and SIGUSR1. A second Ctrl-C raises `KeyboardInterrupt`."""

    def __init__(self, doing: str = "finishing this call, then saving") -> None:
        """
        Args:
            doing: what the process does next, for the message.
        """
        self._doing = doing
        self.signal_name: str | None = None
        self._handled = _handled_by(self._note, signal.SIGINT, *_FROM_SCHEDULERS)

    def __enter__(self) -> "Interrupt":
        self._handled.__enter__()
        return self

    def __exit__(self, *_) -> None:
        self._handled.__exit__(None, None, None)

    def _note(self, number: int, _) -> None:
        if self.signal_name and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal_name = signal.Signals(number).name
        _PROGRESS.info("\n%s: %s", self.signal_name, self._doing)


class Stopped(KeyboardInterrupt):
    """Raised by SIGTERM and SIGUSR1 where Ctrl-C raises `KeyboardInterrupt`."""

    def __init__(self, signal_name: str):
        """
        Args:
            signal_name: such as `SIGTERM`.
        """
        super().__init__(signal_name)
        self.signal_name = signal_name


def as_by_ctrl_c() -> contextlib.AbstractContextManager[None]:
    """Context manager in which SIGTERM and SIGUSR1 raise `Stopped`, so that cleanup runs as after Ctrl-C."""

    def stop(number: int, _) -> None:
        raise Stopped(signal.Signals(number).name)

    return _handled_by(stop, *_FROM_SCHEDULERS)


@contextlib.contextmanager
def _handled_by(handler: Callable, *numbers: signal.Signals) -> Iterator[None]:
    previous = {}
    if threading.current_thread() is threading.main_thread():  # Python allows handlers only there
        previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def exit_code(signal_name: str) -> int:
    """The exit code that shells give a process ended by a signal."""
    return 128 + signal.Signals[signal_name].value
