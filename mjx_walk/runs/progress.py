"""The progress of a training: a bar in a terminal, else log messages."""

import logging
import math
import sys
import time

from tqdm import tqdm

from mjx_walk.runs.metrics import Row
from mjx_walk.utils.text import duration, format_score

__all__ = ["Progress"]

_LOG = logging.getLogger("mjx_walk.progress")
_SECONDS_BETWEEN_LINES = 10.0
"""Interval of the log messages."""


class Progress:
    """Speed, return, episode length and the time left.

    Speed and time left do not count the first call, which compiles. Progress stays silent unless the logger
    `mjx_walk.progress` shows information, as it does in commands.
    """

    def __init__(self, total_steps: int, done_steps: int, is_shown: bool = True):
        """
        Args:
            total_steps: environment steps at the end of the run.
            done_steps: environment steps at the start.
            is_shown: whether this process shows the progress.
        """
        self._total = total_steps
        self._is_shown = is_shown
        self._is_terminal = is_shown and sys.stderr.isatty() and _LOG.isEnabledFor(logging.INFO)
        self._bar = tqdm(
            desc="compiling",
            total=total_steps,
            initial=done_steps,
            unit="step",
            unit_scale=True,
            disable=not self._is_terminal,
        )
        if is_shown and not self._is_terminal and done_steps < total_steps:
            _LOG.info("Compiling the training, which takes from seconds to minutes")
        self._is_compiled = False
        self._last_line = -math.inf
        self._evaluated: float | None = None
        self._unprinted: Row | None = None

    def update(self, row: Row) -> None:
        """Show one row."""
        if not self._is_shown:
            return
        steps = int(row["env_steps"])
        if not self._is_compiled:
            self._restart(steps)
        self._evaluated = row.get("eval/return", self._evaluated)
        if self._is_terminal:
            self._bar.set_postfix(self._scores(row), refresh=False)
            self._bar.update(steps - self._bar.n)
        elif "eval/return" in row or time.monotonic() - self._last_line > _SECONDS_BETWEEN_LINES:
            self._print(row)
        else:
            self._unprinted = row
        self._is_compiled = True

    def close(self) -> None:
        """Show the last row, and leave the bar as it is."""
        if self._unprinted:
            self._print(self._unprinted)
        self._bar.refresh()
        self._bar.close()

    def _scores(self, row: Row) -> dict[str, str]:
        shown = {}
        if row.get("episode/return") is not None:
            shown = {"return": format_score(row["episode/return"]), "length": f"{row['episode/length']:,.0f}"}
        if self._evaluated is not None:
            shown["eval"] = format_score(self._evaluated)
        return shown

    def _restart(self, steps: int) -> None:
        """Let the bar's speed begin here."""
        if self._is_terminal:
            self._bar.set_description("training", refresh=False)
            self._bar.start_t = self._bar.last_print_t = time.time()
            self._bar.initial = self._bar.last_print_n = self._bar.n = steps

    def _print(self, row: Row) -> None:
        self._unprinted, self._last_line = None, time.monotonic()
        steps, rate = row["env_steps"], row["speed/steps_per_second"]
        parts = [f"{steps:>13,.0f} steps"]
        parts += [f"{rate:>9,.0f}/s"] if self._is_compiled else []
        parts += [f"{name} {value}" for name, value in self._scores(row).items()]
        if self._is_compiled and steps < self._total:
            parts.append(f"{duration((self._total - steps) / max(rate, 1e-9))} left")
        _LOG.info("%s", "  ".join(parts))
