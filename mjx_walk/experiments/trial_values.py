"""The value of a trial: what its evaluations during training have reached."""

import bisect

from mjx_walk.experiments.suggestions import TICKS
from mjx_walk.logs.metrics import Row

__all__ = ["NUM_EVALUATIONS", "value_at"]

NUM_EVALUATIONS = 3
"""Newest evaluations during training whose mean is the value of a trial."""


def value_at(logs: list[list[Row]], total_steps: int, tick: int = TICKS) -> float | None:
    """The value of a trial after a part of its training.

    It is the mean over seeds of the mean of the last `NUM_EVALUATIONS` evaluations. Those of untrained policies do not
    count.

    Args:
        logs: rows of `metrics.jsonl` of each seed.
        total_steps: environment steps of the complete training.
        tick: number of parts of the training, from 1 to `TICKS`.

    Returns:
        The value, or None if a seed has not come that far or has no evaluation.
    """
    means = []
    for rows in logs:
        index = bisect.bisect_left([row["env_steps"] * TICKS for row in rows], tick * total_steps)
        if index == len(rows):
            return None
        evaluations = [row["eval/return"] for row in rows[: index + 1] if _is_evaluated(row)][-NUM_EVALUATIONS:]
        if not evaluations:
            return None
        means.append(sum(evaluations) / len(evaluations))
    return sum(means) / len(means)


def _is_evaluated(row: Row) -> bool:
    return row.get("eval/return") is not None and (row.get("eval/env_steps") or 0) > 0
