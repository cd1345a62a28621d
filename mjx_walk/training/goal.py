"""The return at which a training ends before its last step."""

import logging
from collections.abc import Sequence

from mjx_walk.logs.metrics import Row

__all__ = ["Goal"]

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

    def take(self, rows: Sequence[Row], is_main: bool) -> None:
        """Read the rows of a call, one for each run. The main process logs that the training ends."""
        if self._return is None:
            return
        for i, row in enumerate(rows):
            self._has_reached[i] |= float(row.get("eval/return", "-inf")) >= self._return
        if self.is_reached and is_main:
            steps = f"{rows[0]['env_steps']:,}"
            _LOGGER.info(f"Training ends at step {steps}: every evaluation has reached {self._return:,}")
