"""Learning curves, reward terms and losses of a run, drawn from its `metrics.jsonl`."""

from pathlib import Path

import matplotlib.figure

from mjx_walk.runs.metrics import Row, read_rows, write_csv
from mjx_walk.runs.run_folder import RunFolder

AXES = (("env_steps", 1e6, "million environment steps"), ("wall_seconds", 1.0, "seconds since start"))
"""What curves are drawn against: the key of a row, its unit, its label."""


def plot_run(folder: RunFolder) -> list[Path]:
    """Draw the curves that `metrics.jsonl` holds.

    Returns:
        `learning_curve.png` (return and episode length against steps and wall-clock), `reward_terms.png`,
        `losses.png`, and `metrics.csv`, all rows as a table; none where nothing was logged.
    """
    rows = read_rows(folder.metrics)
    if not rows:
        return []
    terms = sorted({k for row in rows for k in row if k.startswith("episode/reward_")})
    losses = sorted({k for row in rows for k in row if k.startswith("train/")})
    return [
        _learning_curve(rows, folder.path / "learning_curve.png"),
        _grid(rows, terms, "per episode", folder.path / "reward_terms.png"),
        _grid(rows, losses, "", folder.path / "losses.png"),
        write_csv(rows, folder.path / "metrics.csv"),
    ]


def series_of(rows: list[Row], x: str, y: str) -> tuple[list[float], list[float]]:
    """The values of `x` and `y` in those rows that have the latter."""
    pairs = [(row[x], row[y]) for row in rows if row.get(y) is not None]
    return [p[0] for p in pairs], [p[1] for p in pairs]


def _learning_curve(rows: list[Row], path: Path) -> Path:
    figure = matplotlib.figure.Figure(figsize=(10, 6.5), layout="constrained")
    grid = figure.subplots(2, 2, sharex="col")
    for column, (axis, unit, label) in enumerate(AXES):
        for line, (quantity, title) in enumerate((("return", "return"), ("length", "episode length"))):
            plot = grid[line][column]
            for source, style in (("episode", {"alpha": 0.6}), ("eval", {"marker": "o", "markersize": 4})):
                is_eval = source == "eval" and axis == "env_steps"
                xs, ys = series_of(rows, "eval/env_steps" if is_eval else axis, f"{source}/{quantity}")
                if xs:
                    name = {"episode": "while training", "eval": "deterministic evaluation"}[source]
                    plot.plot([x / unit for x in xs], ys, label=name, **style)
            plot.set_ylabel(title)
            plot.grid(alpha=0.3)
        grid[1][column].set_xlabel(label)
    if grid[0][0].get_legend_handles_labels()[0]:
        grid[0][0].legend()
    figure.savefig(path, dpi=110)
    return path


def _grid(rows: list[Row], names: list[str], ylabel: str, path: Path) -> Path:
    columns = min(len(names), 4) or 1
    lines = -(-len(names) // columns) or 1
    figure = matplotlib.figure.Figure(figsize=(3.4 * columns, 2.4 * lines), layout="constrained")
    plots = figure.subplots(lines, columns, squeeze=False).flat
    for unused in plots[len(names) :]:
        unused.set_axis_off()
    for plot, name in zip(plots, names, strict=False):
        xs, ys = series_of(rows, "env_steps", name)
        plot.plot([x / 1e6 for x in xs], ys)
        plot.set_title(name.partition("/")[2], fontsize=9)
        plot.set_xlabel("million steps", fontsize=8)
        plot.set_ylabel(ylabel, fontsize=8)
        plot.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path
