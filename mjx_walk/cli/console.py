"""Output of a command: log messages, warnings in one line, and streams whose reader may end before the command."""

import contextlib
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from typing import IO, Any

from mjx_walk.machine.streams import open_standard_streams
from mjx_walk.utils.text import printable

__all__ = ["console"]

_usual_format = warnings.formatwarning


class _Output:
    """A text stream that drops its text once its reader has ended, as `head` does. The command finishes its work."""

    def __init__(self, stream: IO[str] | None):
        """
        Args:
            stream: what to write to; None where the process was started with a closed stream.
        """
        self._stream: Any = stream or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # until the process ends
        if hasattr(self._stream, "reconfigure"):
            self._stream.reconfigure(errors="backslashreplace")  # an encoding may lack letters

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._drop_text()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._drop_text()

    def end(self) -> None:
        """Flush what can be written, and drop the rest. Otherwise the end of the process would raise."""
        try:
            self.flush()
        except OSError:
            self._drop_text()

    def _drop_text(self) -> None:
        """Send this text and all further text to the null device."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _Handler(logging.Handler):
    """Print log messages without a prefix: information to stdout, warnings and progress to stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        is_warning = record.levelno >= logging.WARNING
        text = f"{record.levelname.lower()}: {record.getMessage()}" if is_warning else record.getMessage()
        is_progress = record.name == "mjx_walk.progress"
        with contextlib.suppress(OSError):  # a terminal that has closed does not end a training
            print(text, file=sys.stderr if is_warning or is_progress else sys.stdout, flush=True)


class _OneLineOnce:
    """Formats warnings for users: one line without source code, and each line once, however many places say it."""

    def __init__(self) -> None:
        self._shown: set[str] = set()

    def __call__(
        self, message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
    ) -> str:
        if category is not UserWarning:
            return _usual_format(message, category, filename, lineno, line)
        text = f"warning: {printable(str(message))}\n"
        if text in self._shown:
            return ""
        self._shown.add(text)
        return text


def _is_not_about_gpus(record: logging.LogRecord) -> bool:
    """Whether a message of JAX is not the one of a GPU that it does not use. `machine.nvidia` says why."""
    return not record.getMessage().startswith(("An NVIDIA GPU may be present", "CUDA backend failed to initialize"))


def _say_nothing_of_interrupts(unraisable: "sys.UnraisableHookArgs") -> None:
    """Hide a Ctrl-C that meets code which cannot raise, such as a callback of the garbage collector."""
    if not (unraisable.exc_type and issubclass(unraisable.exc_type, KeyboardInterrupt)):
        sys.__unraisablehook__(unraisable)


@contextlib.contextmanager
def console() -> Iterator[None]:
    """Show this package's log messages, format warnings in one line, and outlive the reader of the output."""
    open_standard_streams()
    logger, handler = logging.getLogger("mjx_walk"), _Handler()
    level, propagate, format_warning = logger.level, logger.propagate, warnings.formatwarning
    stdout, stderr = sys.stdout, sys.stderr
    outputs = _Output(stdout), _Output(stderr)
    sys.stdout, sys.stderr = outputs  # type: ignore[assignment]
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False  # other libraries may have added handlers to the root logger
    warnings.formatwarning = _OneLineOnce()  # type: ignore[assignment]
    unraisable_hook, sys.unraisablehook = sys.unraisablehook, _say_nothing_of_interrupts
    jax_logger = logging.getLogger("jax._src.xla_bridge")
    jax_logger.addFilter(_is_not_about_gpus)
    try:
        yield
    finally:
        for output in outputs:
            output.end()
        sys.stdout, sys.stderr = stdout, stderr
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagate
        warnings.formatwarning = format_warning
        sys.unraisablehook = unraisable_hook
        jax_logger.removeFilter(_is_not_about_gpus)
