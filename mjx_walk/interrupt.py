"""Stop a run at the end of its chunk instead of in the middle of it."""

import signal
import sys
import threading

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR1") if hasattr(signal, name))


class Interrupt:
    """While entered, Ctrl-C, SIGTERM and SIGUSR1 only leave a note; a second Ctrl-C stops at once."""

    def __init__(self, doing: str = "finishing this chunk, then saving") -> None:
        self._doing = doing
        self.signal_name: str | None = None
        self._previous: dict[signal.Signals, object] = {}

    def __enter__(self) -> "Interrupt":
        if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handlers
            for number in _SIGNALS:
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, _) -> None:
        if self.signal_name and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal_name = signal.Signals(number).name
        print(f"\n{self.signal_name}: {self._doing}", file=sys.stderr, flush=True)


def exit_code(signal_name: str) -> int:
    """The shell's convention for a process that a signal ended."""
    return 128 + signal.Signals[signal_name].value
