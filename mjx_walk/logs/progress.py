"""The speed of a training, and the progress of a training and of a scoring: a bar in a terminal, else log messages."""

import collections
import logging
import math
import shutil
import sys
import time
from collections.abc import MutableMapping

from tqdm import tqdm

from mjx_walk.logs.metrics import Row
from mjx_walk.utils.text import duration, format_score

__all__ = ["Progress", "ScoringProgress", "Speed"]

_LOGGER = logging.getLogger("mjx_walk.progress")
_SECONDS_BETWEEN_LINES = 10.0
"""Interval of the log messages."""
_SECONDS_OF_SPEED = 10.0
"""Seconds over which the speed is averaged."""
_BAR = "{desc}{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}{speed}{postfix}"
_MOST_IN_DIGITS = 1_000
"""Largest total of a bar that writes its numbers without a unit prefix: 150, not 0.15k."""
_COLUMNS_FOR_LENGTH = 100
"""Width of a terminal from which on the bar also shows the length of the episodes."""


class Speed:
    """Calls per second over about `_SECONDS_OF_SPEED` seconds, including evaluation and saving."""

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
        while len(self._times) > 1 and now - self._times[1][0] > _SECONDS_OF_SPEED:
            self._times.popleft()
        then, call_then = self._times[0]
        if not self._has_compiled:
            self._times.clear()  # the speeds of later calls leave compiling out
            self._has_compiled = True
        self._times.append((now, call))
        return (call - call_then) / max(now - then, 1e-9)


class _Bar(tqdm):
    """A bar with the speed and the time left in words, none of them before the first update."""

    has_time_left = True
    """Whether the time left is known."""

    @property
    def format_dict(self) -> MutableMapping[str, object]:
        values = super().format_dict
        done, seconds = values["n"] - values["initial"], values["elapsed"]
        values["speed"] = ""
        if done > 0 and seconds > 0:
            rate = done / seconds
            values["speed"] = f" {tqdm.format_sizeof(rate)}/s"
            if self.has_time_left and values["n"] < values["total"]:
                values["speed"] += f" {_in_minutes((values['total'] - values['n']) / rate)} left"
        return values

    def restart(self, done: int) -> None:
        """Let the speed begin here."""
        self.start_t = self.last_print_t = time.time()
        self.initial = self.last_print_n = self.n = done


def _in_minutes(seconds: float) -> str:
    """Time left as text, without the seconds of long times: `4 min 41 s`, `41 min`, `1 h 2 min`."""
    return f"{round(seconds / 60)} min" if 600 <= seconds < 3570 else duration(seconds)


def _make_bar(stage: str, total: int, done: int, is_shown: bool) -> _Bar:
    return _Bar(
        desc=f"{stage}: ",
        total=total,
        initial=done,
        unit_scale=total > _MOST_IN_DIGITS,
        dynamic_ncols=True,
        bar_format=_BAR,
        disable=not is_shown,
    )


def _is_terminal() -> bool:
    """Whether progress is shown, and as a bar."""
    return sys.stderr.isatty() and _LOGGER.isEnabledFor(logging.INFO)


class Progress:
    """Speed, return, episode length and the time left.

    Speed and time left count neither the first call, which compiles, nor the calls that only fill the replay. Progress
    stays silent unless the logger `mjx_walk.progress` shows information, as it does in commands.
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
        self._is_terminal = is_shown and _is_terminal()
        self._bar = _make_bar("compiling", total_steps, done_steps, self._is_terminal)
        if is_shown and not self._is_terminal and done_steps < total_steps:
            _LOGGER.info("Compiling the training program, which takes seconds to minutes")
        self._is_compiled = False
        self._is_filling = False
        self._steps = done_steps
        self._last_line = -math.inf
        self._evaluated: float | None = None
        self._unprinted: Row | None = None

    def update(self, row: Row) -> None:
        """Show one row."""
        if not self._is_shown:
            return
        self._steps = steps = int(row["env_steps"])
        was_filling, self._is_filling = self._is_filling, row.get("train/critic_updates") == 0
        if self._is_terminal and (not self._is_compiled or was_filling != self._is_filling):
            self._bar.restart(steps)
            self._bar.has_time_left = not self._is_filling  # learning is slower
        self.show_stage("filling the replay" if self._is_filling else "training")
        if self._is_filling and not was_filling and not self._is_terminal:
            _LOGGER.info("Filling the replay, before learning starts")
        self._evaluated = row.get("eval/return", self._evaluated)
        if self._is_terminal:
            self._bar.set_postfix(self._scores(row), refresh=False)
            self._bar.update(steps - self._bar.n)
        elif "eval/return" in row or time.monotonic() - self._last_line > _SECONDS_BETWEEN_LINES:
            self._print(row)
        else:
            self._unprinted = row
        self._is_compiled = True

    def show_stage(self, stage: str) -> None:
        """Say at the bar's start what is being done, until the next row."""
        if self._is_terminal and self._bar.desc != f"{stage}: ":
            self._bar.set_description(stage)

    def close(self) -> None:
        """Show the last row, and leave the bar as it is. Say what follows a complete training."""
        if self._unprinted:
            self._print(self._unprinted)
        if self._is_compiled:
            self.show_stage("filling the replay" if self._is_filling else "training")
        self._bar.refresh()
        self._bar.close()
        if self._is_compiled and self._steps >= self._total:
            _LOGGER.info("Evaluating the final policy and drawing the curves")

    def _scores(self, row: Row) -> dict[str, str]:
        shown = {}
        if row.get("episode/return") is not None:
            shown = {"return": format_score(row["episode/return"]), "length": f"{row['episode/length']:,.0f}"}
            if self._is_terminal and shutil.get_terminal_size().columns < _COLUMNS_FOR_LENGTH:
                del shown["length"]
        if self._evaluated is not None:
            shown["eval"] = format_score(self._evaluated)
        return shown

    def _print(self, row: Row) -> None:
        self._unprinted, self._last_line = None, time.monotonic()
        steps, rate = row["env_steps"], row["speed/steps_per_second"]
        parts = [f"{steps:>13,.0f} steps"]
        parts += [f"{rate:>9,.0f}/s"] if self._is_compiled else []
        parts += [f"{name} {value}" for name, value in self._scores(row).items()]
        if self._is_compiled and steps < self._total and not self._is_filling:
            parts.append(f"{duration((self._total - steps) / max(rate, 1e-9))} left")
        _LOGGER.info("%s", "  ".join(parts))


class ScoringProgress:
    """Steps of episodes that are played side by side: a bar in a terminal, and else a message every ten seconds."""

    def __init__(self, num_episodes: int, max_steps: int, stage: str = "scoring"):
        """
        Args:
            num_episodes: episodes to play.
            max_steps: steps until the last of them ends at the latest.
            stage: what they are played for.
        """
        self._num_episodes = num_episodes
        self._max_steps = max_steps
        self._is_terminal = _is_terminal()
        self._bar = _make_bar(stage, max_steps, 0, self._is_terminal)
        self._started = self._last_line = time.monotonic()
        self._first = 0
        """Steps at which the time starts. The first step compiles the policy."""

    def update(self, steps: int, num_over: int) -> None:
        """Show the steps so far, and how many episodes are over."""
        now = time.monotonic()
        if not self._first:
            self._first, self._started = steps, now
            if self._is_terminal:
                self._bar.restart(steps)
        if self._is_terminal:
            self._bar.set_postfix_str(f"{num_over:,} of {self._num_episodes:,} episodes over", refresh=False)
            self._bar.update(steps - self._bar.n)
        elif now - self._last_line > _SECONDS_BETWEEN_LINES:
            self._last_line = now
            left = duration((self._max_steps - steps) * (now - self._started) / max(steps - self._first, 1))
            episodes = f"{num_over:,} of {self._num_episodes:,} episodes over"
            _LOGGER.info("  step %s of %s, %s, at most %s left", f"{steps:,}", f"{self._max_steps:,}", episodes, left)

    def close(self) -> None:
        """Remove the bar; the result follows."""
        self._bar.leave = False
        self._bar.close()
