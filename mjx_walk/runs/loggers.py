"""Where the rows of a run go: `metrics.jsonl`, TensorBoard, Weights & Biases, the terminal."""

import importlib.util
import json
import math
import secrets
import sys
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from mjx_walk.runs.config import Config, flatten
from mjx_walk.runs.metrics import Row, read_rows
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.runs.tensorboard import SummaryWriter
from mjx_walk.utils.errors import UserError

_SECONDS_BETWEEN_LINES = 10.0
"""Where there is no terminal, progress is a plain line this often."""


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


def require_wandb(config: Config) -> None:
    """Before a run begins that is to be logged there.

    Raises:
        UserError: the package is not installed, or nobody is logged in.
    """
    if not config.wandb_project:
        return
    if importlib.util.find_spec("wandb") is None:
        raise UserError(f"wandb_project={config.wandb_project} needs Weights & Biases: pip install wandb")
    import wandb

    if wandb.setup().settings.mode == "online":
        try:
            wandb.login()
        except wandb.errors.UsageError as error:
            advice = "log in with `wandb login`, or set WANDB_MODE=offline"
            raise UserError(f"wandb_project={config.wandb_project}: {advice}") from error


class WandbLog:
    """One W&B run for one run folder; a resumed run goes on in it. `WANDB_MODE=offline` keeps it on the disk."""

    def __init__(self, config: Config, folder: RunFolder):
        """
        Args:
            config: with `wandb_project`.
            folder: prepared run folder; `wandb_id.txt` in it says which run is its own.
        """
        import wandb

        identity = folder.path / "wandb_id.txt"
        if not identity.exists():
            identity.write_text(secrets.token_hex(4))
        self._run: Any = wandb.init(
            project=config.wandb_project,
            id=identity.read_text().strip(),
            name=f"{folder.path.parent.name}/{folder.path.name}",
            dir=str(folder.path),
            config=flatten(config),
            resume="allow",
        )

    def write(self, row: Row) -> None:
        """Log one row at its environment steps. Steps that are there already, from before a run was resumed, stay."""
        self._run.log({name: value for name, value in row.items() if math.isfinite(value)}, step=int(row["env_steps"]))

    def close(self) -> None:
        """Until everything is sent, or on the disk."""
        self._run.finish()


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
