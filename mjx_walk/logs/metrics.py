"""Named metrics from the device's sums, and the log rows that hold them."""

import csv
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_walk.storage.files import open_to_read, replacing
from mjx_walk.utils.errors import UserError, failed_read
from mjx_walk.utils.types import Metrics, Reduction

__all__ = ["Row", "mean_row", "name_metrics", "physics_warnings", "read_rows", "write_csv"]

Row = dict[str, float]
"""One line of `metrics.jsonl`. `name_metrics` lists the names."""

_MAX_NUMBER = 1e300
_MAX_LINE = 10_000_000
"""Bytes of a row; a usual one has about a thousand."""
_MAX_VALUES = 8_000_000
"""Values of all rows, of which a usual one has about thirty. They take half a gigabyte."""
_VALUES_PER_ROW = 8
"""Values that take as much memory as an empty row."""
_MAX_LINES = 1_000_000
_MAX_NAME = 10_000
_FORMULA = ("=", "+", "-", "@")
"""Characters that a spreadsheet takes for the start of a formula."""
_MAX_CELLS = 20_000_000
"""Cells of a CSV file, with the empty ones. A stranger's rows may each have names of their own."""
_MANY = 0.01
"""Fraction of non-finite steps above which the physics is not the likely reason."""


def name_metrics(metrics: Metrics, steps_per_iteration: int) -> Row:
    """Convert the metrics of one call to a log row.

    Args:
        metrics: `[iterations] f32` each: those of `VectorEnv.step`, of `InlineEvaluator` and of the algorithm.
        steps_per_iteration: environment steps of an iteration, over all devices.

    Returns:
        `episode/…`: means over the finished episodes, absent if there are none. `physics/…` and `resets/…`: counts.
        `train/…`: metrics of the algorithm, absent without a value. `eval/…`: the last finished evaluation, if there
        is one; `eval/env_steps` are the steps after which its policy was copied.
    """
    by_reduction: dict[Reduction, dict[str, np.ndarray]] = {reduction: {} for reduction in Reduction}
    for name, metric in metrics.items():
        values = np.asarray(metric.value, np.float64)
        by_reduction[metric.reduction][name] = values if metric.has_value is None else values[metric.has_value]
    counts = {name: float(value.sum()) for name, value in by_reduction[Reduction.SUM].items()}
    episodes = counts["episodes"]
    row: Row = {"episode/count": episodes}
    if episodes:
        sums = by_reduction[Reduction.PER_EPISODE]
        row |= {f"episode/{name}": float(value.sum() / episodes) for name, value in sums.items()}
    row["physics/nonfinite"] = counts["nonfinite"]
    row["physics/overflow"] = counts["overflow"]
    row["resets/count"] = counts["resets"]
    row["resets/reuse_rate"] = counts["resets_reused"] / max(counts["resets"], 1.0)
    scores = {name.removeprefix("eval_"): value for name, value in by_reduction[Reduction.FIRST_DEVICE].items()}
    if scores["return"].size:
        last = {name: float(value[-1]) for name, value in scores.items()}
        row["eval/env_steps"] = last.pop("iteration") * steps_per_iteration
        row |= {f"eval/{name}": value for name, value in last.items()}
    # Nothing is learned from the first batches, or before the replay holds enough.
    means = by_reduction[Reduction.MEAN]
    return row | {f"train/{name}": float(value.mean()) for name, value in means.items() if value.size}


def physics_warnings(row: Row, num_steps: int) -> dict[str, str]:
    """Warnings about the physics of a row, by the metric that shows the problem.

    Args:
        row: result of `name_metrics`.
        num_steps: environment steps of the row.
    """
    found = {}
    if row["physics/overflow"]:
        found["physics/overflow"] = (
            "a Warp buffer overflowed and contacts were lost in some environments: enlarge CONTACTS_PER_ENV or "
            "CONSTRAINTS_PER_ENV in envs/physics/mjx_warp.py"
        )
    if row["physics/nonfinite"] > _MANY * num_steps:
        found["physics/nonfinite"] = (
            f"{row['physics/nonfinite']:,.0f} of {num_steps:,} steps ended their episodes without a reward, because "
            "the state, the observation or the reward was not finite; check your own reward function or model"
        )
    return found


def read_rows(path: Path) -> list[Row]:
    """All rows of a `metrics.jsonl`. Invalid lines are skipped, and one warning counts them.

    A last line that a crash has cut off is skipped silently.

    Raises:
        UserError: it is far larger than the log of a run, is not a regular file, or cannot be read.
    """
    rows: list[Row] = []
    names: dict[str, str] = {}  # one copy of each name for all rows
    first_invalid, num_invalid, num_values = 0, 0, 0
    row: Row | None = {}
    try:
        for number, line in enumerate(_lines(path), start=1):
            if row is None:
                first_invalid, num_invalid = first_invalid or number - 1, num_invalid + 1
            row = _as_row(line)
            if row is not None:
                rows.append({names.setdefault(name, name): value for name, value in row.items()})
                num_values += len(row) + _VALUES_PER_ROW
            if num_values > _MAX_VALUES or number > _MAX_LINES:
                raise UserError(f"{path} has too many rows for the log of a run; remove it, or some of its lines")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UserError(str(failed_read(path, error))) from error
    if num_invalid:
        more = f" and {num_invalid - 1} more" if num_invalid > 1 else ""
        warnings.warn(f"line {first_invalid}{more} of {path} cannot be read; skipped", stacklevel=2)
    return rows


def _lines(path: Path) -> Iterator[str]:
    """The lines of a file, of which one that is too long to be a row comes in parts."""
    with open_to_read(path) as file:
        while line := file.readline(_MAX_LINE):
            yield line.decode(errors="replace")


def _as_row(line: str) -> Row | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict) or not all(map(_is_value, row.values())) or not all(map(_is_name, row)):
        return None
    return row if all(row.get(name) is not None and row[name] >= 0 for name in ("env_steps", "wall_seconds")) else None


def _is_value(value: Any) -> bool:
    """Whether a value is a finite number of a size that can be drawn, or `null`, which stands for NaN."""
    return value is None or (type(value) in (int, float) and abs(value) < _MAX_NUMBER)


def _is_name(name: str) -> bool:
    """Whether a metric's name is one that a spreadsheet does not take for a formula, and a terminal can show."""
    return name[:1].isalpha() and name.isprintable() and len(name) <= _MAX_NAME


def write_csv(rows: Sequence[Mapping[str, object]], path: Path) -> Path:
    """Write rows as CSV with a column for every name in any row. Missing values are empty.

    The last names are left out if there were too many cells.
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    most = max(_MAX_CELLS // max(len(rows), 1), 1)
    with replacing(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names[:most], extrasaction="ignore")
        writer.writeheader()
        writer.writerows({name: _as_cell(value) for name, value in row.items()} for row in rows)
    return path


def _as_cell(value: object) -> object:
    """A value that a spreadsheet does not take for a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def mean_row(rows: list[Row]) -> Row:
    """Means over the runs that have a value, for display."""
    values = {name: [row[name] for row in rows if name in row] for name in {name for row in rows for name in row}}
    return {name: sum(found) / len(found) for name, found in values.items()}
