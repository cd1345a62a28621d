"""Learning curves, reward terms and losses of a run, drawn from its `metrics.jsonl`."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes

from mjx_walk.runs.metrics import Row, read_rows, write_csv
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.utils.files import replacing
from mjx_walk.viewing.figures import standard_style

_X_AXES = (("env_steps", 1e6, "million environment steps"), ("wall_seconds", 1.0, "seconds since start"))
"""Key of a row, unit and label of each horizontal axis."""
_QUANTITIES = (("return", "return"), ("length", "episode length"))
"""Key of a row after its prefix, and label, of each vertical axis."""
_MAX_PLOTS = 32


@standard_style()
def plot_run(folder: RunFolder) -> list[Path]:
    """Draw the curves of a run into its folder.

    Returns:
        `learning_curve.png` (return and episode length against steps and seconds), `reward_terms.png`,
        `losses.png`, and `metrics.csv` with all rows. The list is empty if nothing is logged yet.
    """
    rows = read_rows(folder.metrics)
    if not rows:
        return []
    terms = sorted({key for row in rows for key in row if key.startswith("episode/reward_")})
    losses = sorted({key for row in rows for key in row if key.startswith("train/")})
    return [
        _learning_curve(rows, folder.path / "learning_curve.png"),
        _grid(rows, terms, "per episode", folder.path / "reward_terms.png"),
        _grid(rows, losses, "", folder.path / "losses.png"),
        write_csv(rows, folder.path / "metrics.csv"),
    ]


def series(rows: list[Row], x: str, y: str) -> np.ndarray:
    """Values of `x` and `y` in the rows that have `y`, `[2, N] f64`."""
    pairs = [(row[x], row[y]) for row in rows if row.get(y) is not None]
    return np.array(pairs, np.float64).reshape(-1, 2).T


def learning_axes(figure: matplotlib.figure.Figure) -> Iterator[tuple[Axes, str, str, float]]:
    """Add four labelled plots to a figure: return and episode length against steps and seconds.

    Returns:
        For each plot its axes, the quantity (`return` or `length`), and the key and the unit of its horizontal axis.
    """
    grid = figure.subplots(2, 2, sharex="col")
    for axes_row, (quantity, title) in zip(grid, _QUANTITIES, strict=True):
        for axes, (key, unit, label) in zip(axes_row, _X_AXES, strict=True):
            axes.set_ylabel(title)
            axes.grid(alpha=0.3)
            if axes in grid[-1]:
                axes.set_xlabel(label)
            yield axes, quantity, key, unit


def _learning_curve(rows: list[Row], path: Path) -> Path:
    figure = matplotlib.figure.Figure(figsize=(10, 6.5), layout="constrained")
    for axes, quantity, key, unit in learning_axes(figure):
        x, y = series(rows, key, f"episode/{quantity}")
        if x.size:
            axes.plot(x / unit, y, label="while training", alpha=0.6)
        x, y = series(rows, "eval/env_steps" if key == "env_steps" else key, f"eval/{quantity}")
        if x.size:
            axes.plot(x / unit, y, label="deterministic evaluation", marker="o", markersize=4)
    first = figure.axes[0]
    if first.get_legend_handles_labels()[0]:
        first.legend()
    with replacing(path) as new:
        figure.savefig(new, dpi=110)
    return path


def _grid(rows: list[Row], names: list[str], ylabel: str, path: Path) -> Path:
    """Draw one small plot per metric, up to `_MAX_PLOTS`."""
    names = names[:_MAX_PLOTS]
    num_columns = min(len(names), 4) or 1
    num_rows = -(-len(names) // num_columns) or 1
    figure = matplotlib.figure.Figure(figsize=(3.4 * num_columns, 2.4 * num_rows), layout="constrained")
    plots = figure.subplots(num_rows, num_columns, squeeze=False).flat
    for unused in plots[len(names) :]:
        unused.set_axis_off()
    for axes, name in zip(plots, names, strict=False):
        x, y = series(rows, "env_steps", name)
        axes.plot(x / 1e6, y)
        axes.set_title(name.partition("/")[2], fontsize=9)
        axes.set_xlabel("million steps", fontsize=8)
        axes.set_ylabel(ylabel, fontsize=8)
        axes.grid(alpha=0.3)
    with replacing(path) as new:
        figure.savefig(new, dpi=110)
    return path
