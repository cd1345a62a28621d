"""From the device's sums to named metrics, and the rows that hold them."""

import csv
import json
import warnings
from pathlib import Path

import numpy as np

from mjx_walk.utils.types import Metrics

Row = dict[str, float]
"""One line of `metrics.jsonl`; see `name_metrics` for the names."""

_SUMS = ("nonfinite", "overflow", "resets", "resets_reused")
_MANY = 0.01
"""The share of steps that are not finite from which on it is no rare accident of the physics."""


def is_sum(name: str, reward_terms: tuple[str, ...]) -> bool:
    """Whether a metric of an update is a sum over the copies."""
    return name in ("episodes", "return", "length", *_SUMS, *reward_terms)


def name_metrics(metrics: Metrics, reward_terms: tuple[str, ...], steps_per_iteration: int) -> Row:
    """Turn the metrics of one chunk into a log row.

    Args:
        metrics: `[updates] f32` each: the sums of `VectorEnv.step`, and the learner's means.
        reward_terms: which of them are reward terms.
        steps_per_iteration: environment steps of an update.

    Returns:
        `episode/…`: means over the episodes that ended (absent if none did); `physics/…` and `resets/…`: counts;
        `train/…`: the learner's; and if an evaluation has ended, `eval/…`, with the steps behind the policy that
        was evaluated as `eval/env_steps`.
    """
    values = {name: np.asarray(value, np.float64) for name, value in metrics.items()}
    episodes = values.pop("episodes").sum()
    row: Row = {"episode/count": float(episodes)}
    for name in ("return", "length", *reward_terms):
        total = values.pop(name).sum()
        if episodes:
            row[f"episode/{name}"] = float(total / episodes)
    counts = {name: float(values.pop(name).sum()) for name in _SUMS}
    row["physics/nonfinite"] = counts["nonfinite"]
    row["physics/overflow"] = counts["overflow"]
    row["resets/count"] = counts["resets"]
    row["resets/reuse_rate"] = counts["resets_reused"] / max(counts["resets"], 1.0)
    scores = {name: values.pop(f"eval_{name}") for name in ("return", "return_std", "length", "iteration")}
    ended = np.flatnonzero(~np.isnan(scores["return"]))
    if ended.size:
        last = {name: float(value[ended[-1]]) for name, value in scores.items()}
        row["eval/env_steps"] = last.pop("iteration") * steps_per_iteration
        row |= {f"eval/{name}": value for name, value in last.items()}
    # Over the updates that have it: nothing is learned from a first batch, or before a replay is filled.
    known = {name: value[~np.isnan(value)] for name, value in values.items()}
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
