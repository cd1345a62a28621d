"""Returns after equal numbers of steps and equal times, from the evaluations during training."""

import numpy as np

from mjx_walk.experiments.logged_runs import LoggedRun
from mjx_walk.utils.text import format_score
from mjx_walk.viewing.run_plots import evaluations

__all__ = ["at_budgets"]

_BUDGETS = {
    "1M steps": ("env_steps", 1e6),
    "5M steps": ("env_steps", 5e6),
    "20M steps": ("env_steps", 2e7),
    "60 s": ("wall_seconds", 60.0),
    "120 s": ("wall_seconds", 120.0),
    "300 s": ("wall_seconds", 300.0),
}
"""Title of each column, and where it reads the evaluations: the quantity and its value."""


def at_budgets(runs: list[LoggedRun]) -> dict[str, str]:
    """Mean returns of runs that differ in their seed, by budget: evaluations during training, interpolated linearly.

    A cell is a dash unless the evaluations of every seed reach its budget.
    """
    return {title: format_score(_mean_return(runs, *budget)) for title, budget in _BUDGETS.items()}


def _mean_return(runs: list[LoggedRun], quantity: str, value: float) -> float | None:
    """The mean over runs of the return at a value of `env_steps` or `wall_seconds`; None where one has none there."""
    returns = []
    for run in runs:
        x, y = evaluations(run.rows, quantity, "return")
        if not len(x) or not x[0] <= value <= x[-1]:
            return None
        returns.append(np.interp(value, x, y))
    return float(np.mean(returns))
