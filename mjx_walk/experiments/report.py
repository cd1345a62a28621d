"""Reports on a folder of runs, grouped by algorithm and settings: learning curves, a Markdown table and a CSV file."""

import dataclasses
import warnings
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
import scipy.stats

from mjx_walk.runs.config import Config, flatten, read_config
from mjx_walk.runs.metrics import Row, read_rows, write_csv
from mjx_walk.runs.run_folder import RunFolder, open_existing
from mjx_walk.runs.scores import BEST, BETTER, FINAL, ScoreFile, read_scores
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.files import replacing, write_text
from mjx_walk.viewing.run_plots import learning_axes, series

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

    def score(self, policy: str) -> dict[str, Any]:
        """Scores of the final or the best policy, empty if it was not scored.

        A file with one block holds the better of both, which counts as the best.
        """
        names = (policy, BETTER) if policy == BEST else (policy,)
        return (self.scores and self.scores.block(*names)) or {}


def read_runs(folder: Path) -> list[LoggedRun]:
    """Read all runs below a folder that have logged something.

    Raises:
        UserError: there are none, they are of different environments, or one holds links or pipes.
    """
    runs = []
    for path in sorted(folder.rglob("config.yaml")):
        run = open_existing(path.parent)
        rows = read_rows(run.metrics)
        if rows:
            runs.append(LoggedRun(read_config(path), rows, _scores(run)))
    if not runs:
        raise UserError(f"no runs below '{folder}' have logged anything yet")
    names = {f"{run.config.env.name} {run.config.env.version}" for run in runs}
    if len(names) > 1:
        raise UserError(f"the runs below '{folder}' are of different environments: {', '.join(sorted(names))}")
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


def _settings(config: Config) -> dict[str, Any]:
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


def write_report(folder: Path) -> Path:
    """Write `comparison.png`, `comparison.md` and `comparison.csv` about all runs below a folder.

    Returns:
        The Markdown file.

    Raises:
        UserError: `read_runs` fails, or the folder cannot be written to.
    """
    groups = group(read_runs(folder))
    path = folder / "comparison.md"
    try:
        _draw(groups, folder / "comparison.png")
        write_csv([_csv_row(name, run) for name, runs in groups.items() for run in runs], folder / "comparison.csv")
        write_text(path, _markdown(groups))
    except OSError as error:
        raise UserError(f"cannot write to '{folder}': {error.strerror}") from error
    return path


def _draw(groups: dict[str, list[LoggedRun]], path: Path) -> None:
    """Draw every run thin and the mean of its group bold."""
    figure = matplotlib.figure.Figure(figsize=(12, 8), layout="constrained")
    for axes, quantity, key, unit in learning_axes(figure):
        for number, (name, runs) in enumerate(groups.items()):
            found = [series(run.rows, key, f"episode/{quantity}") for run in runs]
            curves = [(x / unit, y) for x, y in found if x.size]
            if not curves:
                continue
            color = f"C{number % 10}"
            for curve in curves:
                axes.plot(*curve, color=color, alpha=0.35, linewidth=0.8)
            x, mean, values = mean_curve(curves)
            axes.plot(x, mean, color=color, linewidth=2.2, label=f"{name} ({len(curves)})".replace("$", r"\$"))
            bounds = interval(values)
            if bounds:
                axes.fill_between(x, *bounds, color=color, alpha=0.2, linewidth=0)
    env = next(iter(groups.values()))[0].config.env
    figure.suptitle(f"{env.name} {env.version}, during training: each seed thin, their mean bold")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles:
        num_columns = max(160 // (len(max(labels, key=len)) + 8), 1)  # as many as fit the figure's width
        figure.legend(handles, labels, loc="outside lower center", ncols=num_columns, fontsize=9)
    with replacing(path) as new:
        figure.savefig(new, dpi=110)


def _markdown(groups: dict[str, list[LoggedRun]]) -> str:
    """A table with two rows per group, for the final and for the best policy, and a table with a row per run."""
    summary = [_summary(name, runs, policy) for name, runs in groups.items() for policy in (FINAL, BEST)]
    runs = [_run_cells(name, run) for name, same in groups.items() for run in same]
    legend = (
        "Scores are mean returns in Gymnasium. The final policy is the newest one. The best policy has the highest "
        "evaluation during training. For files of older versions, it is the better of both on the scored episodes.\n"
    )
    return f"{_table(summary)}\n{_table(runs)}\n{legend}"


def _table(rows: list[dict[str, str]]) -> str:
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _summary(variant: str, runs: list[LoggedRun], policy: str) -> dict[str, str]:
    scores = np.array([run.score(policy)["mean"] for run in runs if run.score(policy)])
    low, high = interval(scores) or (None, None)
    iqm = scipy.stats.trim_mean(scores, 0.25) if len(scores) >= MIN_SEEDS_FOR_IQM else None
    return {
        "variant": variant,
        "policy": policy,
        "score": _cell(scores.mean() if len(scores) else None),
        "std over seeds": _cell(scores.std(ddof=1) if len(scores) > 1 else None),
        "95% interval, low": _cell(low),
        "95% interval, high": _cell(high),
        "IQM": _cell(iqm),
        "seeds scored": str(len(scores)),
        "seeds": str(len(runs)),
        "million steps": f"{np.mean([run.rows[-1]['env_steps'] for run in runs]) / 1e6:,.2f}",
        "seconds": _cell(np.mean([run.rows[-1]["wall_seconds"] for run in runs])),
    }


def _run_cells(variant: str, run: LoggedRun) -> dict[str, str]:
    final, best, last = run.score(FINAL), run.score(BEST), run.rows[-1]
    return {
        "variant": variant,
        "seed": str(run.config.seed),
        "final": _cell(final.get("mean")),
        "std over episodes": _cell(final.get("std")),
        "best": _cell(best.get("mean")),
        "its std over episodes": _cell(best.get("std")),
        "million steps": f"{last['env_steps'] / 1e6:,.2f}",
        "seconds": _cell(last["wall_seconds"]),
        "seeds in its process": _cell(_seeds_together(run)),
    }


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:,.0f}"


def _csv_row(variant: str, run: LoggedRun) -> dict[str, Any]:
    last = run.rows[-1]
    scores = {f"{policy}_{name}": run.score(policy).get(name) for policy in (FINAL, BEST) for name in ("mean", "std")}
    return {
        "variant": variant,
        "seed": run.config.seed,
        **scores,
        "env_steps": last["env_steps"],
        "wall_seconds": last["wall_seconds"],
        "seeds_together": _seeds_together(run),
        "run_dir": run.config.run_dir,
    }


def _seeds_together(run: LoggedRun) -> float:
    """Number of seeds that shared the run's process, and so its seconds."""
    return run.rows[-1].get("speed/seeds_together", 1)
