"""The speed of a training."""

import collections
import time

__all__ = ["Speed"]

_WINDOW = 10.0
"""Seconds over which the speed is averaged."""


class Speed:
    """Calls per second over about `_WINDOW` seconds, including evaluation and saving."""

    def __init__(self, call: int):
        """
        Args:
            call: number of calls before the first one that is timed.
        """
        self._times = collections.deque([(time.monotonic(), call)])
        self._has_compiled = False

    def after(self, call: int) -> float:
        """The speed at the end of a call."""
        now = time.monotonic()
        while len(self._times) > 1 and now - self._times[1][0] > _WINDOW:
            self._times.popleft()
        then, call_then = self._times[0]
        if not self._has_compiled:
            self._times.clear()  # the speeds of later calls leave compiling out
            self._has_compiled = True
        self._times.append((now, call))
        return (call - call_then) / max(now - then, 1e-9)
