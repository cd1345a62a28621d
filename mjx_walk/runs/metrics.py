"""From the device's sums to named metrics, and the rows that hold them."""

import csv
import json
import warnings
from pathlib import Path

import numpy as np

from mjx_walk.utils.types import Metrics, Reduction

Row = dict[str, float]
"""One line of `metrics.jsonl`; see `name_metrics` for the names."""

_MANY = 0.01
"""The fraction of non-finite steps above which they are no rare accident of the physics."""


def name_metrics(metrics: Metrics, steps_per_iteration: int) -> Row:
    """Turn the metrics of one call into a log row.

    Args:
        metrics: `[iterations] f32` each: those of `VectorEnv.step` and `InlineEvaluator`, and the learner's.
        steps_per_iteration: environment steps of an iteration, over all devices.

    Returns:
        `episode/…`: means over the episodes that ended (absent if none did); `physics/…` and `resets/…`: counts;
        `train/…`: the learner's, absent without a value; and `eval/…` if an evaluation has ended, with the environment
        steps before its policy as `eval/env_steps`.
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
    """What a user must know of the physics behind a row, by the metric that shows it.

    Args:
        row: from `name_metrics`.
        num_steps: environment steps behind it.
    """
    found = {}
    if row["physics/overflow"]:
        found["physics/overflow"] = (
            "a Warp buffer overflowed, so that contacts were lost in some copies: enlarge CONTACTS_PER_ENV or "
            "CONSTRAINTS_PER_ENV in envs/physics/mjx_warp.py"
        )
    if row["physics/nonfinite"] > _MANY * num_steps:
        found["physics/nonfinite"] = (
            f"{row['physics/nonfinite']:,.0f} of {num_steps:,} steps ended their episodes without a reward, since the "
            "state, the observation or the reward was not finite: a reward or a model of your own may be why"
        )
    return found


def read_rows(path: Path) -> list[Row]:
    """All rows of a `metrics.jsonl`. What is no row is left out, with a warning unless it is a last line cut off by a
    crash."""
    if not path.exists():
        return []
    lines = path.read_text(errors="replace").splitlines()
    rows = []
    for number, line in enumerate(lines, start=1):
        row = _as_row(line)
        if row:
            rows.append(row)
        elif number < len(lines):
            warnings.warn(f"line {number} of {path} cannot be read, and is left out", stacklevel=2)
    return rows


def _as_row(line: str) -> Row | None:
    try:
        row = json.loads(line)
    except json.JSONDecodeError:
        return None
    return row if isinstance(row, dict) and "env_steps" in row else None


def write_csv(rows: list[Row], path: Path) -> Path:
    """The same rows as a table, whose columns are all names that any row has, in their order; an unknown value is
    empty."""
    names = dict.fromkeys(name for row in rows for name in row)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return path
