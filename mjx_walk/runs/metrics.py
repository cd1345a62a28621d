"""Named metrics from the device's sums, and the log rows that hold them."""

import csv
import json
import warnings
from pathlib import Path

import numpy as np

from mjx_walk.utils.files import replacing
from mjx_walk.utils.types import Metrics, Reduction

__all__ = ["Row", "name_metrics", "physics_warnings", "read_rows", "write_csv"]

Row = dict[str, float]
"""One line of `metrics.jsonl`. `name_metrics` lists the names."""

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
        by_reduction[metric.reduction][name] = np.asarray(metric.value, np.float64)
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
    ended = np.flatnonzero(~np.isnan(scores["return"]))
    if ended.size:
        last = {name: float(value[ended[-1]]) for name, value in scores.items()}
        row["eval/env_steps"] = last.pop("iteration") * steps_per_iteration
        row |= {f"eval/{name}": value for name, value in last.items()}
    # Nothing is learned from the first batches, or before the replay holds enough.
    known = {name: value[~np.isnan(value)] for name, value in by_reduction[Reduction.MEAN].items()}
    return row | {f"train/{name}": float(value.mean()) for name, value in known.items() if value.size}


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
    """All rows of a `metrics.jsonl`. Invalid lines are skipped with a warning.

    A last line that a crash has cut off is skipped silently.
    """
    if not path.exists():
        return []
    lines = path.read_text(errors="replace").splitlines()
    rows = []
    for number, line in enumerate(lines, start=1):
        row = _as_row(line)
        if row:
            rows.append(row)
        elif number < len(lines):
            warnings.warn(f"line {number} of {path} cannot be read and is skipped", stacklevel=2)
    return rows


def _as_row(line: str) -> Row | None:
    try:
        row = json.loads(line)
    except json.JSONDecodeError:
        return None
    return row if isinstance(row, dict) and "env_steps" in row else None


def write_csv(rows: list[Row], path: Path) -> Path:
    """Write rows as CSV with a column for every name in any row. Missing values are empty."""
    names = dict.fromkeys(name for row in rows for name in row)
    with replacing(path) as new, new.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return path
