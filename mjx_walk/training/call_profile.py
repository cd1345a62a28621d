"""Record a few calls of a training with JAX's profiler."""

import logging
from pathlib import Path
from typing import Self

import jax

from mjx_walk.utils.errors import first_line

__all__ = ["CALLS_BEFORE", "CallProfile"]

_LOGGER = logging.getLogger(__name__)

CALLS_BEFORE = 2
"""The first call compiles the training's programs, and the programs that read its results compile after it."""


class CallProfile:
    """Records program calls from the third one on, and writes the recording before the next call or on exit.

    A recording that fails costs the training nothing: a warning says why.
    """

    def __init__(self, folder: Path, num_calls: int):
        """
        Args:
            folder: where to write the recording, for TensorBoard and Perfetto.
            num_calls: number of calls to record; 0 records none.
        """
        self._folder, self._num_calls = folder, num_calls
        self._calls, self._is_recording = 0, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def next_call(self) -> None:
        """Start or end the recording where it is due. The previous call must have ended on the device."""
        if self._calls == CALLS_BEFORE + self._num_calls:
            self._stop()
        elif self._calls == CALLS_BEFORE:
            self._start()
        self._calls += 1

    def _start(self) -> None:
        options = jax.profiler.ProfileOptions()
        options.python_tracer_level = 0  # it would slow the host down
        try:
            jax.profiler.start_trace(self._folder, profiler_options=options)
            self._is_recording = True
        except RuntimeError as error:  # the user's own program records already
            _LOGGER.warning(f"cannot record calls: {first_line(error)}")

    def _stop(self) -> None:
        if not self._is_recording:
            return
        self._is_recording = False
        try:
            if not self._folder.parent.exists():
                raise OSError("its run folder was removed")  # the profiler would create it again
            jax.profiler.stop_trace()
        except (OSError, RuntimeError) as error:
            _LOGGER.warning(f"cannot write the recording of calls to {self._folder}: {first_line(error)}")
