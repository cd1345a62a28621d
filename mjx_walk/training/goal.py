"""The return at which a training ends before its last step."""

import logging
from collections.abc import Sequence

from mjx_walk.logs.metrics import Row, read_rows
from mjx_walk.storage.run_folder import RunFolder

__all__ = ["Goal", "has_reached"]

_LOGGER = logging.getLogger(__name__)


class Goal:
    """Whether every run has had an evaluation with the return that ends the training."""

    def __init__(self, stop_at_return: float | None, num_runs: int):
        """
        Args:
            stop_at_return: mean return of an inline evaluation; None if the training does not end before its last step.
            num_runs: runs that train together.
        """
        self._return = stop_at_return
        self._has_reached = [False] * num_runs

    @property
    def is_reached(self) -> bool:
        return all(self._has_reached)

    def recall(self, folders: Sequence[RunFolder], env_steps: int) -> None:
        """Read the rows before a resume.

        Args:
            folders: of the runs.
            env_steps: environment steps at which they resume; later rows do not count.
        """
        for i, folder in enumerate(folders if self._return is not None else ()):
            rows = [row for row in read_rows(folder.metrics) if row["env_steps"] <= env_steps]
            self._has_reached[i] = has_reached(rows, self._return)

    def take(self, rows: Sequence[Row], is_main: bool) -> None:
        """Read the rows of a call, one for each run. The main process logs that the training ends."""
        if self._return is None:
            return
        for i, row in enumerate(rows):
            self._has_reached[i] |= has_reached([row], self._return)
        if self.is_reached and is_main:
            steps = f"{rows[0]['env_steps']:,}"
            _LOGGER.info(f"Training ends at step {steps}: every evaluation has reached {self._return:,}")


def has_reached(rows: Sequence[Row], stop_at_return: float | None) -> bool:
    """Whether an evaluation in a run's rows has the return that ends its training."""
    if stop_at_return is None:
        return False
    returns = (row.get("eval/return") for row in rows)
    return any(value is not None and value >= stop_at_return for value in returns)
