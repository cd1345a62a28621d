"""What a folder of runs says about their algorithms and settings: curves, a table, a figure."""

import csv
import dataclasses
import json
import warnings
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
import scipy.stats

from mjx_walk.runs.config import Config, flatten, read_config
from mjx_walk.runs.metrics import Row, read_rows
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.curves import AXES, series_of

MIN_SEEDS_FOR_INTERVALS = 5
_POINTS = 200
_QUANTITIES = (("episode/return", "return"), ("episode/length", "episode length"))


@dataclasses.dataclass(frozen=True)
class Curve:
    """One run."""

    config: Config
    rows: list[Row]
    scores: dict | None
    """Of `eval_gymnasium.json`."""


def read_runs(folder: Path) -> list[Curve]:
    """All runs below a folder that have logged something, however they came there.

    Raises:
        UserError: there are none, or they are of different environments.
    """
    runs = []
    for path in sorted(folder.rglob("config.yaml")):
        run = RunFolder(path.parent)
        rows = read_rows(run.metrics)
        if rows:
            runs.append(Curve(read_config(path), rows, _scores(run)))
    if not runs:
        raise UserError(f"no runs below '{folder}' have logged anything yet")
    names = {f"{run.config.env.name} {run.config.env.version}" for run in runs}
    if len(names) > 1:
        raise UserError(f"the runs below '{folder}' are of different environments: {', '.join(sorted(names))}")
    return runs


def _scores(run: RunFolder) -> dict[str, Any] | None:
    """What is in a run's `eval_gymnasium.json`, if it has one that can be read."""
    if not run.gymnasium_scores.exists():
        return None
    try:
        return json.loads(run.gymnasium_scores.read_text())
    except ValueError:
        warnings.warn(f"{run.gymnasium_scores} cannot be read: score the run again", stacklevel=2)
        return None


def group(runs: list[Curve]) -> dict[str, list[Curve]]:
    """Runs that differ in their seed alone, under the algorithm's name and whatever sets them apart from others of
    its kind."""
    by_algo = defaultdict(list)
    for run in runs:
        by_algo[run.config.algo.name].append(run)
    groups: dict[str, list[Curve]] = defaultdict(list)
    for name, same in by_algo.items():
        settings = [_settings(run.config) for run in same]
        varying = [key for key in settings[0] if any(other.get(key) != settings[0][key] for other in settings)]
        for run, values in zip(same, settings, strict=True):
            label = ", ".join([name, *(f"{key.removeprefix('algo.')}={values.get(key)}" for key in varying)])
            groups[label].append(run)
    return dict(groups)


def mean_curve(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mean of several curves, where all of them have values; nothing where they do not overlap.

    Args:
        curves: `(x, y)` each, x rising.

    Returns:
        x, `[P]`; the mean, `[P]`; and all curves at x, `[curves, P]`.
    """
    first, last = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    x = np.linspace(first, last, _POINTS if first <= last else 0)
    values = np.stack([np.interp(x, *curve) for curve in curves])
    return x, values.mean(axis=0), values


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Bootstrap 95% interval of the mean over the first axis, `[seeds, …]`; None for fewer than five seeds."""
    if len(values) < MIN_SEEDS_FOR_INTERVALS:
        return None
    found = scipy.stats.bootstrap(
        (values,), np.mean, axis=0, n_resamples=2000, method="percentile", rng=np.random.default_rng(0)
    )
    return found.confidence_interval.low, found.confidence_interval.high


def write_report(folder: Path) -> Path:
    """Write `comparison.png`, `comparison.md` and `comparison.csv` about all runs below a folder.

    Returns:
        The Markdown file.

    Raises:
        UserError: see `read_runs`; or the folder cannot be written to.
    """
    groups = group(read_runs(folder))
    path = folder / "comparison.md"
    try:
        _draw(groups, folder / "comparison.png")
        _write_csv(groups, folder / "comparison.csv")
        path.write_text(_markdown(groups))
    except OSError as error:
        raise UserError(f"cannot write to '{folder}': {error.strerror}") from error
    return path


def _settings(config: Config) -> dict:
    return {key: value for key, value in flatten(config).items() if key not in ("run_dir", "resume", "seed")}


def _draw(groups: dict[str, list[Curve]], path: Path) -> None:
    figure = matplotlib.figure.Figure(figsize=(12, 8), layout="constrained")
    grid = figure.subplots(2, 2, sharex="col")
    for line, (quantity, title) in enumerate(_QUANTITIES):
        for column, (axis, unit, label) in enumerate(AXES):
            plot = grid[line][column]
            for number, (name, runs) in enumerate(groups.items()):
                series = [series_of(run.rows, axis, quantity) for run in runs]
                curves = [(np.array(xs) / unit, np.array(ys)) for xs, ys in series if xs]
                if not curves:
                    continue
                color = f"C{number % 10}"
                for curve in curves:
                    plot.plot(*curve, color=color, alpha=0.35, linewidth=0.8)
                x, mean, values = mean_curve(curves)
                plot.plot(x, mean, color=color, linewidth=2.2, label=f"{name} ({len(curves)})")
                bounds = interval(values)
                if bounds:
                    plot.fill_between(x, *bounds, color=color, alpha=0.2, linewidth=0)
            plot.set_ylabel(title)
            plot.grid(alpha=0.3)
            if line:
                plot.set_xlabel(label)
    env = next(iter(groups.values()))[0].config.env
    figure.suptitle(f"{env.name} {env.version}: every seed thin, their mean bold, while training")
    handles, labels = grid[0][0].get_legend_handles_labels()
    if handles:
        columns = max(160 // (len(max(labels, key=len)) + 8), 1)  # as fit side by side
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=9)
    figure.savefig(path, dpi=110)


def _markdown(groups: dict[str, list[Curve]]) -> str:
    lines = [
        "| variant | seeds | score in Gymnasium, mean over seeds | spread (std) | 95% interval | lowest seed "
        "| million steps | seconds |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, runs in groups.items():
        scores = np.array([run.scores["mean"] for run in runs if run.scores])
        bounds = interval(scores)
        cells = [
            name,
            f"{len(scores)} of {len(runs)} scored" if len(scores) < len(runs) else str(len(runs)),
            f"{scores.mean():,.0f}" if len(scores) else "–",
            f"{scores.std(ddof=1):,.0f}" if len(scores) > 1 else "–",
            f"{bounds[0]:,.0f} to {bounds[1]:,.0f}" if bounds else "–",
            f"{scores.min():,.0f}" if len(scores) else "–",
            f"{np.mean([run.rows[-1]['env_steps'] for run in runs]) / 1e6:,.2f}",
            f"{np.mean([run.rows[-1]['wall_seconds'] for run in runs]):,.0f}" + _side_by_side(runs),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _side_by_side(runs: list[Curve]) -> str:
    """With how many seeds their seconds were shared."""
    together = sorted({int(run.rows[-1].get("speed/seeds_together", 1)) for run in runs})
    return "" if together == [1] else f", {' or '.join(map(str, together))} seeds side by side"


def _write_csv(groups: dict[str, list[Curve]], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        figures = ("gymnasium_mean", "gymnasium_std", "env_steps", "wall_seconds", "seeds_together")
        writer.writerow(["variant", "seed", *figures, "run_dir"])
        for name, runs in groups.items():
            for run in runs:
                scores, last = run.scores or {}, run.rows[-1]
                writer.writerow(
                    [name, run.config.seed, scores.get("mean"), scores.get("std"), last["env_steps"],
                     last["wall_seconds"], last.get("speed/seeds_together", 1), run.config.run_dir]
                )  # fmt: skip
