"""Signal handling: a run stops after its current call, and later stages stop as after Ctrl-C."""

import atexit
import contextlib
import logging
import signal
import threading
from collections.abc import Callable, Iterator

__all__ = ["Interrupt", "Stopped", "as_by_ctrl_c", "exit_code", "ignore_at_exit", "postponed", "undisturbed"]

_LOGGER = logging.getLogger("mjx_walk.progress")
_NAMES = ("SIGTERM", "SIGUSR1", "SIGHUP")
_FROM_OUTSIDE = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
"""Signals of schedulers, and of a terminal that closes."""


class Interrupt:
    """Context manager that records Ctrl-C, SIGTERM, SIGUSR1 and SIGHUP. A second Ctrl-C raises `KeyboardInterrupt`."""

    def __init__(self, doing: str = "finishing this call, then saving") -> None:
        """
        Args:
            doing: what the process does next, for the message.
        """
        self._doing = doing
        self.signal_name: str | None = None
        self._handled = _handled_by(self._note, signal.SIGINT, *_FROM_OUTSIDE)

    def __enter__(self) -> "Interrupt":
        self._handled.__enter__()
        return self

    def __exit__(self, *_) -> None:
        self._handled.__exit__(None, None, None)

    def _note(self, number: int, _) -> None:
        if self.signal_name and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal_name = signal.Signals(number).name
        _LOGGER.info("\n%s: %s", self.signal_name, self._doing)


class Stopped(KeyboardInterrupt):
    """Raised by SIGTERM, SIGUSR1 and SIGHUP where Ctrl-C raises `KeyboardInterrupt`."""

    def __init__(self, signal_name: str):
        """
        Args:
            signal_name: such as `SIGTERM`.
        """
        super().__init__(signal_name)
        self.signal_name = signal_name


def as_by_ctrl_c() -> contextlib.AbstractContextManager[None]:
    """Context manager in which the signals from outside raise `Stopped`, so that cleanup runs as after Ctrl-C."""

    def stop(number: int, _) -> None:
        raise Stopped(signal.Signals(number).name)

    return _handled_by(stop, *_FROM_OUTSIDE)


@contextlib.contextmanager
def postponed(doing: str) -> Iterator[None]:
    """Context manager in which signals wait: the first one takes effect when the block ends.

    Args:
        doing: what the process does until then, for the message.
    """
    received: list[int] = []

    def note(number: int, _) -> None:
        received.append(number)
        _LOGGER.info("\n%s: %s", signal.Signals(number).name, doing)

    with _handled_by(note, signal.SIGINT, *_FROM_OUTSIDE):
        yield
    if received:
        signal.raise_signal(received[0])


@contextlib.contextmanager
def undisturbed(doing: str) -> Iterator[None]:
    """Context manager for a device program that runs Python callbacks, as Warp's programs do.

    Signals take effect when the block ends: an exception in a callback, or an exit while one runs, crashes the process.
    Only a second Ctrl-C raises `KeyboardInterrupt` at once.

    Args:
        doing: what the process does until then, for the message.
    """
    with Interrupt(doing) as interrupt:
        yield
    if interrupt.signal_name:
        signal.raise_signal(signal.Signals[interrupt.signal_name])


@contextlib.contextmanager
def _handled_by(handler: Callable, *numbers: signal.Signals) -> Iterator[None]:
    previous = {}
    if threading.current_thread() is threading.main_thread():  # Python allows handlers only there
        previous = {number: signal.signal(number, handler) for number in numbers if not _is_ignored_hangup(number)}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def _is_ignored_hangup(number: signal.Signals) -> bool:
    """Whether `nohup` has asked to outlive the terminal."""
    return number.name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN


def ignore_at_exit() -> None:
    """Ignore signals once this process exits: all work is done then, and Python would print a traceback."""
    atexit.unregister(_ignore)
    atexit.register(_ignore)  # what is registered last runs first


def _ignore() -> None:
    for number in (signal.SIGINT, *_FROM_OUTSIDE):
        signal.signal(number, signal.SIG_IGN)


def exit_code(signal_name: str) -> int:
    """The exit code that shells give a process ended by a signal."""
    return 128 + signal.Signals[signal_name].value
