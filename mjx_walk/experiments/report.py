"""The report on runs of one environment: learning curves, Markdown tables and a CSV file."""

from pathlib import Path

import matplotlib.figure
import numpy as np
import scipy.stats
from matplotlib.axes import Axes

from mjx_walk.experiments.logged_runs import MIN_SEEDS_FOR_IQM, LoggedRun, interval, mean_curve
from mjx_walk.logs.metrics import write_csv
from mjx_walk.storage.files import replacing, write_text
from mjx_walk.storage.scores import BEST, FINAL
from mjx_walk.utils.text import format_score, in_markdown
from mjx_walk.viewing.run_plots import evaluations, learning_axes, series

__all__ = ["DRAWN", "LEGEND", "csv_row", "draw_curves", "run_cells", "table", "write_comparison"]

DRAWN = (
    "Lines: with exploration noise, each seed thin, their mean bold. Dots: evaluations without noise. "
    "Stars: final policies in Gymnasium."
)
LEGEND = (
    "Scores are mean returns in Gymnasium. The final policy is the newest one. The best policy has the highest "
    "evaluation during training. In files from older versions, it is the better of the two on the scored episodes.\n"
)


def write_comparison(folder: Path, groups: dict[str, list[LoggedRun]]) -> Path:
    """Write `comparison.png`, `comparison.md` and `comparison.csv`.

    Args:
        folder: where to write them.
        groups: runs of one environment, by label.

    Returns:
        The Markdown file.

    Raises:
        OSError: the folder cannot be written to.
    """
    _draw(groups, folder / "comparison.png")
    write_csv([csv_row(name, run) for name, runs in groups.items() for run in runs], folder / "comparison.csv")
    path = folder / "comparison.md"
    write_text(path, _markdown(groups))
    return path


def draw_curves(axes: Axes, groups: dict[str, list[LoggedRun]], quantity: str, key: str, unit: float) -> None:
    """Draw every run thin, the mean of its group bold, and its interval. Dots and stars are of single runs.

    Args:
        axes: where to draw.
        groups: runs by label.
        quantity: `return` or `length`, the vertical axis.
        key: of a log row, the horizontal axis.
        unit: of the horizontal axis.
    """
    for number, (name, runs) in enumerate(groups.items()):
        found = [series(run.rows, key, f"episode/{quantity}") for run in runs]
        curves = [(x / unit, y) for x, y in found if x.size]
        if not curves:
            continue
        color = f"C{number % 10}"
        for curve in curves:
            axes.plot(*curve, color=color, alpha=0.35, linewidth=0.8)
        for run in runs:
            x, y = evaluations(run.rows, key, quantity)
            axes.plot(x / unit, y, "o", color=color, markersize=5, markeredgecolor="white", markeredgewidth=0.7)
            if quantity == "return" and run.score(FINAL):
                end = (run.rows[-1][key] / unit, run.score(FINAL)["mean"])
                axes.plot(*end, "*", color=color, markersize=12, markeredgecolor="white", markeredgewidth=0.7, zorder=3)
        x, mean, values = mean_curve(curves)
        axes.plot(x, mean, color=color, linewidth=2.2, label=f"{name} ({len(curves)})")
        bounds = interval(values)
        if bounds:
            axes.fill_between(x, *bounds, color=color, alpha=0.2, linewidth=0)


def _draw(groups: dict[str, list[LoggedRun]], path: Path) -> None:
    figure = matplotlib.figure.Figure(figsize=(12, 8), layout="constrained")
    for axes, quantity, key, unit in learning_axes(figure):
        draw_curves(axes, groups, quantity, key, unit)
    task = next(iter(groups.values()))[0].task
    figure.suptitle(f"{task}. {DRAWN}")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles:
        num_columns = max(160 // (len(max(labels, key=len)) + 8), 1)  # as many as fit the figure's width
        figure.legend(handles, labels, loc="outside lower center", ncols=num_columns, fontsize=9)
    with replacing(path) as new:
        figure.savefig(new, dpi=110)


def _markdown(groups: dict[str, list[LoggedRun]]) -> str:
    """A table with two rows per group, for the final and for the best policy, and a table with a row per run."""
    rows = [_summary(name, runs, policy) for name, runs in groups.items() for policy in (FINAL, BEST)]
    runs = [run_cells(name, run) for name, same in groups.items() for run in same]
    return f"{table(rows)}\n{table(runs)}\n{LEGEND}"


def table(rows: list[dict[str, str]]) -> str:
    """A Markdown table of at least one row; all rows have the same columns. Cells may hold text of strangers."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(map(in_markdown, row.values()) for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _summary(variant: str, runs: list[LoggedRun], policy: str) -> dict[str, str]:
    scores = np.array([run.score(policy)["mean"] for run in runs if run.score(policy)])
    low, high = interval(scores) or (None, None)
    iqm = scipy.stats.trim_mean(scores, 0.25) if len(scores) >= MIN_SEEDS_FOR_IQM else None
    return {
        "variant": variant,
        "policy": policy,
        "score": format_score(scores.mean() if len(scores) else None),
        "std over seeds": format_score(scores.std(ddof=1) if len(scores) > 1 else None),
        "95% interval, low": format_score(low),
        "95% interval, high": format_score(high),
        "IQM": format_score(iqm),
        "seeds scored": str(len(scores)),
        "seeds": str(len(runs)),
        "million steps": f"{np.mean([run.rows[-1]['env_steps'] for run in runs]) / 1e6:,.2f}",
        "seconds": f"{np.mean([run.rows[-1]['wall_seconds'] for run in runs]):,.0f}",
    }


def run_cells(variant: str, run: LoggedRun) -> dict[str, str]:
    """Cells about one run, by column."""
    final, best, last = run.score(FINAL), run.score(BEST), run.rows[-1]
    return {
        "variant": variant,
        "seed": str(run.config.seed),
        "final": format_score(final.get("mean")),
        "std over episodes": format_score(final.get("std")),
        "best": format_score(best.get("mean")),
        "its std over episodes": format_score(best.get("std")),
        "million steps": f"{last['env_steps'] / 1e6:,.2f}",
        "seconds": f"{last['wall_seconds']:,.0f}",
        "seeds in its process": f"{run.seeds_together:,.0f}",
    }


def csv_row(variant: str, run: LoggedRun) -> dict[str, object]:
    """Values about one run, by column."""
    last = run.rows[-1]
    scores = {f"{policy}_{name}": run.score(policy).get(name) for policy in (FINAL, BEST) for name in ("mean", "std")}
    return {
        "variant": variant,
        "seed": run.config.seed,
        **scores,
        "env_steps": last["env_steps"],
        "wall_seconds": last["wall_seconds"],
        "seeds_together": run.seeds_together,
        "run_dir": run.config.run_dir,
    }
