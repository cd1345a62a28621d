"""Logs of runs, grouped by algorithm and settings, and statistics over seeds."""

import dataclasses
import warnings
from collections import defaultdict
from pathlib import Path

import numpy as np
import scipy.stats

from mjx_walk.envs import TASKS
from mjx_walk.logs.metrics import Row, read_rows
from mjx_walk.settings.config import Config, flatten
from mjx_walk.settings.saved_config import read_saved_config
from mjx_walk.storage.run_folder import RunFolder, open_existing
from mjx_walk.storage.scores import BEST, BETTER, ScoreBlock, ScoreFile, read_scores
from mjx_walk.utils.errors import UserError

__all__ = ["MIN_SEEDS_FOR_INTERVALS", "MIN_SEEDS_FOR_IQM", "LoggedRun", "group", "interval", "mean_curve", "read_runs"]

MIN_SEEDS_FOR_INTERVALS = 3
MIN_SEEDS_FOR_IQM = 10
_POINTS = 200


@dataclasses.dataclass(frozen=True)
class LoggedRun:
    """One run and what it has logged."""

    config: Config
    rows: list[Row]
    """At least one."""
    scores: ScoreFile | None
    """Contents of `eval_gymnasium.json`."""

    @property
    def task(self) -> str:
        """Gymnasium's id of the environment, or the name of the user's own task."""
        return TASKS[self.config.env.name][0].id_of(self.config.env)

    @property
    def is_standard(self) -> bool:
        """Whether Gymnasium scores it with the environment's default keywords and time limit."""
        return self.config.env.changed().keys() <= {"name", "version", "shaping", "reward_function"}

    @property
    def seeds_together(self) -> float:
        """Number of seeds that shared the run's process, and so its seconds."""
        return self.rows[-1].get("speed/seeds_together", 1)

    def score(self, policy: str) -> ScoreBlock:
        """Scores of the final or the best policy, empty if it was not scored.

        A file with one block holds the better of both, which counts as the best.
        """
        names = (policy, BETTER) if policy == BEST else (policy,)
        return (self.scores and self.scores.block(*names)) or {}


def read_runs(folder: Path) -> list[LoggedRun]:
    """Read all runs below a folder that have logged something.

    Raises:
        UserError: there are none, or one holds links or pipes.
    """
    runs = []
    for path in sorted(folder.rglob("config.yaml")):
        run = open_existing(path.parent)
        rows = read_rows(run.metrics)
        if rows:
            runs.append(LoggedRun(read_saved_config(run), rows, _scores(run)))
    if not runs:
        raise UserError(f"no runs below '{folder}' have logged anything yet")
    return runs


def _scores(run: RunFolder) -> ScoreFile | None:
    """Contents of a run's `eval_gymnasium.json`, if the file exists and can be read."""
    if not run.gymnasium_scores.exists():
        return None
    try:
        return read_scores(run.gymnasium_scores)
    except ValueError:
        warnings.warn(f"{run.gymnasium_scores} cannot be read: score the run again", stacklevel=2)
        return None


def group(runs: list[LoggedRun]) -> dict[str, list[LoggedRun]]:
    """Group runs that differ only in their seed.

    Returns:
        The groups by label: the algorithm, and the settings in which its groups differ.
    """
    by_algo = defaultdict(list)
    for run in runs:
        by_algo[run.config.algo.name].append(run)
    groups: dict[str, list[LoggedRun]] = defaultdict(list)
    for name, same in by_algo.items():
        settings = [_settings(run.config) for run in same]
        varying = [key for key in settings[0] if any(other.get(key) != settings[0][key] for other in settings)]
        for run, values in zip(same, settings, strict=True):
            label = ", ".join([name, *(f"{key.removeprefix('algo.')}={values.get(key)}" for key in varying)])
            groups[label].append(run)
    return dict(groups)


def _settings(config: Config) -> dict[str, object]:
    return {key: value for key, value in flatten(config).items() if key not in ("run_dir", "resume", "seed")}


def mean_curve(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of several curves over the range that all of them cover, which may be empty.

    Args:
        curves: `(x, y)` each, with rising x.

    Returns:
        x, `[P]`; the mean, `[P]`; and all curves at x, `[curves, P]`.
    """
    first, last = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    x = np.linspace(first, last, _POINTS if first <= last else 0)
    values = np.stack([np.interp(x, *curve) for curve in curves])
    return x, values.mean(axis=0), values


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Student's 95% interval of the mean over the first axis, `[seeds, …]`; None for fewer than three seeds.

    With few seeds, a percentile bootstrap is too narrow: of five normal values it covers the mean 84% of the time.
    """
    if len(values) < MIN_SEEDS_FOR_INTERVALS:
        return None
    half_width = scipy.stats.t.ppf(0.975, len(values) - 1) * scipy.stats.sem(values, axis=0)
    return values.mean(axis=0) - half_width, values.mean(axis=0) + half_width
