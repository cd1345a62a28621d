"""From the device's sums to named metrics, and where they are written."""

import csv
import json
import math
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mjx_walk.tensorboard import SummaryWriter
from mjx_walk.types import Metrics

Row = dict[str, float]
"""One line of `metrics.jsonl`; see `name_metrics` for the names."""

_SUMS = ("nonfinite", "overflow", "resets", "resets_reused")
_MANY = 0.01
"""The share of steps that are not finite from which on it is no rare accident of the physics."""
_SECONDS_BETWEEN_LINES = 10.0
"""Where there is no terminal, progress is a plain line this often."""


def is_sum(name: str, reward_terms: tuple[str, ...]) -> bool:
    """Whether a metric of an update is a sum over the copies."""
    return name in ("episodes", "return", "length", *_SUMS, *reward_terms)


def name_metrics(metrics: Metrics, reward_terms: tuple[str, ...], steps_per_update: int) -> Row:
    """Turn the metrics of one chunk into a log row.

    Args:
        metrics: `[updates] f32` each: the sums of `VectorEnv.step`, and the learner's means.
        reward_terms: which of them are reward terms.
        steps_per_update: environment steps of an update.

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
    scores = {name: values.pop(f"eval_{name}") for name in ("return", "return_std", "length", "update")}
    ended = np.flatnonzero(~np.isnan(scores["return"]))
    if ended.size:
        last = {name: float(value[ended[-1]]) for name, value in scores.items()}
        row["eval/env_steps"] = last.pop("update") * steps_per_update
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
            "a Warp buffer overflowed, so that contacts were lost in some copies: enlarge CONTACTS_PER_COPY or "
            "CONSTRAINTS_PER_COPY in envs/physics/mjx_warp.py"
        )
    if row["physics/nonfinite"] > _MANY * num_steps:
        found["physics/nonfinite"] = (
            f"{row['physics/nonfinite']:,.0f} of {num_steps:,} steps ended their episodes without a reward, since the "
            "state, the observation or the reward was not finite: a reward or a model of your own may be why"
        )
    return found


class MetricsWriter:
    """Appends rows to `metrics.jsonl` and to TensorBoard's event file."""

    def __init__(self, run_dir: Path, resume_steps: int | None = None):
        """
        Args:
            run_dir: the run folder.
            resume_steps: where the run resumes; rows written after that by the interrupted run are dropped.
        """
        path = run_dir / "metrics.jsonl"
        if resume_steps is not None:
            rows = [row for row in read_rows(path) if row["env_steps"] <= resume_steps]
            path.write_text("".join(json.dumps(row) + "\n" for row in rows))
        self._file = path.open("a", buffering=1)
        self._events = SummaryWriter(
            str(run_dir), flush_secs=30, purge_step=None if resume_steps is None else resume_steps + 1
        )

    def write(self, row: Row) -> None:
        """Write one row; `env_steps` is its place on the horizontal axis."""
        self._file.write(json.dumps({k: v if math.isfinite(v) else None for k, v in row.items()}) + "\n")
        for name, value in row.items():
            if "/" in name and math.isfinite(value):
                self._events.add_scalar(name, value, int(row["env_steps"]))

    def close(self) -> None:
        self._file.close()
        self._events.close()


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


class Progress:
    """A progress bar with steps, steps/s, return, episode length and time left; plain lines without a terminal."""

    def __init__(self, total_steps: int, done_steps: int):
        self._total = total_steps
        self._is_terminal = sys.stderr.isatty()
        self._bar = tqdm(
            total=total_steps, initial=done_steps, unit="step", unit_scale=True, disable=not self._is_terminal
        )
        self._last_line = -math.inf
        self._evaluated: float | None = None

    def update(self, row: Row) -> None:
        """Show a row."""
        self._evaluated = row.get("eval/return", self._evaluated)
        facts = {
            "return": row.get("episode/return"),
            "length": row.get("episode/length"),
            "eval": self._evaluated,
        }
        shown = {name: f"{value:,.0f}" for name, value in facts.items() if value is not None}
        if self._is_terminal:
            self._bar.set_postfix(shown, refresh=False)
            self._bar.update(int(row["env_steps"]) - self._bar.n)
        elif "eval/return" in row or time.monotonic() - self._last_line > _SECONDS_BETWEEN_LINES:
            self._last_line = time.monotonic()
            left = (self._total - row["env_steps"]) / max(row["speed/steps_per_second"], 1e-9)
            text = "  ".join(f"{name} {value}" for name, value in shown.items())
            rate = row["speed/steps_per_second"]
            print(
                f"{row['env_steps']:>13,.0f} steps  {rate:>9,.0f}/s  {text}  {max(left, 0):,.0f} s left",
                file=sys.stderr,
                flush=True,
            )

    def close(self) -> None:
        self._bar.close()
