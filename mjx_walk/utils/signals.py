"""Signals: a run stops at the end of its chunk, and what comes after it as by Ctrl-C, instead of at once."""

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator

_FROM_SCHEDULERS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGUSR1") if hasattr(signal, name))


class Interrupt:
    """While entered, Ctrl-C, SIGTERM and SIGUSR1 only leave a note; a second Ctrl-C stops at once."""

    def __init__(self, doing: str = "finishing this chunk, then saving") -> None:
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
        print(f"\n{self.signal_name}: {self._doing}", file=sys.stderr, flush=True)


class Stopped(KeyboardInterrupt):
    """Ends what Ctrl-C would end, by another signal."""

    def __init__(self, signal_name: str):
        """
        Args:
            signal_name: such as `SIGTERM`.
        """
        super().__init__(signal_name)
        self.signal_name = signal_name


def as_by_ctrl_c() -> contextlib.AbstractContextManager[None]:
    """While entered, SIGTERM and SIGUSR1 raise `Stopped`, so that what is being saved is saved, as after Ctrl-C."""

    def stop(number: int, _) -> None:
        raise Stopped(signal.Signals(number).name)

    return _handled_by(stop, *_FROM_SCHEDULERS)


@contextlib.contextmanager
def _handled_by(handler: Callable, *numbers: signal.Signals) -> Iterator[None]:
    previous = {}
    if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handlers
        previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def exit_code(signal_name: str) -> int:
    """The shell's convention for a process that a signal ended."""
    return 128 + signal.Signals[signal_name].value
