"""Learning curves, reward terms and losses of a run, drawn from its `metrics.jsonl`."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib.figure
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes

from mjx_walk.envs import TASKS
from mjx_walk.logs.metrics import Row, read_rows, write_csv
from mjx_walk.settings.saved_config import read_saved_config
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.figures import save_figure, standard_style

__all__ = ["THOUSANDS", "evaluations", "learning_axes", "plot_run", "series"]

_X_AXES = (("env_steps", 1e6, "million environment steps"), ("wall_seconds", 1.0, "seconds since start"))
"""Key of a row, unit and label of each horizontal axis."""
THOUSANDS = matplotlib.ticker.StrMethodFormatter("{x:,.10g}")
"""Format of the numbers at an axis."""
_QUANTITIES = (("return", "return"), ("length", "episode length"))
"""Key of a row after its prefix, and label, of each vertical axis."""
_MAX_PLOTS = 32
_FEW_POINTS = 20
"""Curves with fewer points show each of them, so that a single one is visible."""


@standard_style()
def plot_run(folder: RunFolder) -> list[Path]:
    """Draw the curves of a run into its folder.

    Returns:
        `learning_curve.png` (return and episode length against steps and seconds), `reward_terms.png`,
        `losses.png` (what varies), and `metrics.csv` with all rows. The list is empty if nothing is logged yet.
    """
    rows = read_rows(folder.metrics)
    if not rows:
        return []
    title = _title(folder)
    terms = sorted({key for row in rows for key in row if key.startswith("episode/reward_")})
    losses = sorted({key for row in rows for key in row if key.startswith("train/")})
    losses = [key for key in losses if len(rows) == 1 or len({row.get(key) for row in rows}) > 1]
    return [
        _learning_curve(rows, title, folder.path / "learning_curve.png"),
        _grid(rows, terms, f"{title}: reward terms per episode", folder.path / "reward_terms.png"),
        _grid(rows, losses, f"{title}: learning", folder.path / "losses.png"),
        write_csv(rows, folder.path / "metrics.csv"),
    ]


def _title(folder: RunFolder) -> str:
    """Environment, algorithm and seed. A run whose configuration cannot be read keeps the name of its folder."""
    try:
        config = read_saved_config(folder)
    except UserError:
        return folder.path.name
    return f"{TASKS[config.env.name][0].id_of(config.env)}, {config.algo.name}, seed {config.seed}"


def series(rows: list[Row], x: str, y: str) -> np.ndarray:
    """Values of `x` and `y` in the rows that have `y`, `[2, N] f64`."""
    pairs = [(row[x], row[y]) for row in rows if row.get(y) is not None]
    return np.array(pairs, np.float64).reshape(-1, 2).T


def evaluations(rows: list[Row], x: str, quantity: str) -> np.ndarray:
    """The evaluations during training: `x` when training was at the step of the policy, and the result.

    Args:
        rows: of the log.
        x: `env_steps` or `wall_seconds`.
        quantity: `return` or `length`.

    Returns:
        `[2, N] f64`.
    """
    steps, values = series(rows, "eval/env_steps", f"eval/{quantity}")
    return np.array([steps if x == "env_steps" else np.interp(steps, *series(rows, "env_steps", x)), values])


def learning_axes(figure: matplotlib.figure.Figure) -> Iterator[tuple[Axes, str, str, float]]:
    """Add four labelled plots to a figure: return and episode length against steps and seconds.

    Returns:
        For each plot its axes, the quantity (`return` or `length`), and the key and the unit of its horizontal axis.
    """
    grid = figure.subplots(2, 2, sharex="col")
    for axes_row, (quantity, title) in zip(grid, _QUANTITIES, strict=True):
        for axes, (key, unit, label) in zip(axes_row, _X_AXES, strict=True):
            axes.set_ylabel(title)
            axes.yaxis.set_major_formatter(THOUSANDS)
            axes.grid(alpha=0.3)
            if axes in grid[-1]:
                axes.set_xlabel(label)
            yield axes, quantity, key, unit


def _learning_curve(rows: list[Row], title: str, path: Path) -> Path:
    figure = matplotlib.figure.Figure(figsize=(10, 6.5), layout="constrained")
    figure.suptitle(title)
    for axes, quantity, key, unit in learning_axes(figure):
        x, y = series(rows, key, f"episode/{quantity}")
        if x.size:
            axes.plot(x / unit, y, label="with exploration noise", alpha=0.6, marker=_marker(x))
        x, y = evaluations(rows, key, quantity)
        if x.size:
            axes.plot(x / unit, y, label="evaluation, without noise", marker="o", markersize=4)
    first = figure.axes[0]
    if first.get_legend_handles_labels()[0]:
        first.legend()
    return save_figure(figure, path)


def _marker(x: np.ndarray) -> str:
    return "." if x.size < _FEW_POINTS else ""


def _grid(rows: list[Row], names: list[str], title: str, path: Path) -> Path:
    """Draw one small plot per metric, up to `_MAX_PLOTS`."""
    names = names[:_MAX_PLOTS]
    num_columns = min(len(names), 4) or 1
    num_rows = -(-len(names) // num_columns) or 1
    figure = matplotlib.figure.Figure(figsize=(3.4 * num_columns, 2.4 * num_rows + 0.4), layout="constrained")
    figure.suptitle(title)
    plots = figure.subplots(num_rows, num_columns, squeeze=False, sharex=True)
    for unused in plots.flat[len(names) :]:
        unused.set_axis_off()
    for axes, name in zip(plots.flat, names, strict=False):
        x, y = series(rows, "env_steps", name)
        axes.plot(x / 1e6, y, marker=_marker(x))
        axes.set_title(name.partition("/")[2], fontsize=9)
        axes.yaxis.set_major_formatter(THOUSANDS)
        axes.tick_params(labelsize=8, labelbottom=True)
        axes.grid(alpha=0.3)
    figure.supxlabel("million environment steps", fontsize=9)
    return save_figure(figure, path)
