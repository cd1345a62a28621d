"""Learning curves of several runs in one figure."""

import math
from pathlib import Path

import matplotlib.figure
from matplotlib.axes import Axes

from mjx_walk.experiments.logged_runs import LoggedRun, interval, mean_curve
from mjx_walk.experiments.suite import REFERENCES
from mjx_walk.storage.scores import FINAL
from mjx_walk.viewing.figures import save_figure
from mjx_walk.viewing.run_plots import THOUSANDS, evaluations, learning_axes, series

__all__ = ["draw_suite", "draw_task"]

_DRAWN = (
    "Lines: with exploration noise, each seed thin, their mean bold. Dots: evaluations without noise. "
    "Stars: final policies in Gymnasium."
)
_COLUMNS = 4


def draw_task(groups: dict[str, list[LoggedRun]], path: Path) -> None:
    """Draw the runs of one environment: return and episode length against steps and seconds."""
    figure = matplotlib.figure.Figure(figsize=(12, 8), layout="constrained")
    for axes, quantity, key, unit in learning_axes(figure):
        _draw_curves(axes, groups, quantity, key, unit)
    task = next(iter(groups.values()))[0].task
    figure.suptitle(f"{task}. {_DRAWN}")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles:
        num_columns = max(160 // (len(max(labels, key=len)) + 8), 1)  # as many as fit the figure's width
        figure.legend(handles, labels, loc="outside lower center", ncols=num_columns, fontsize=9)
    save_figure(figure, path)


def draw_suite(tasks: dict[str, dict[str, list[LoggedRun]]], path: Path) -> None:
    """One plot per environment, and the legend in the plot that is left, or below."""
    num_rows = math.ceil(len(tasks) / _COLUMNS)
    figure = matplotlib.figure.Figure(figsize=(3.6 * _COLUMNS, 2.7 * num_rows), layout="constrained")
    panels = figure.subplots(num_rows, _COLUMNS, squeeze=False).ravel()
    for axes, (task, groups) in zip(panels, tasks.items(), strict=False):
        _draw_curves(axes, groups, "return", "env_steps", 1e6)
        if task in REFERENCES:
            axes.axhline(REFERENCES[task][1], color="0.4", linewidth=1, linestyle=":", label="reference")
        axes.set_title(task, fontsize=10)
        axes.yaxis.set_major_formatter(THOUSANDS)
        axes.grid(alpha=0.3)
    for axes in panels[len(tasks) :]:
        axes.axis("off")
    for axes in panels[: len(tasks)][-_COLUMNS:]:
        axes.set_xlabel("million environment steps")
    figure.suptitle(f"Returns. {_DRAWN}", fontsize=11)
    handles = {
        label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize=9)
    save_figure(figure, path)


def _draw_curves(axes: Axes, groups: dict[str, list[LoggedRun]], quantity: str, key: str, unit: float) -> None:
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
