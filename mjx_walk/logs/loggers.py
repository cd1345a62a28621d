"""Loggers for the rows of a run: `metrics.jsonl`, TensorBoard, Weights & Biases."""

import errno
import importlib.util
import json
import math
import os
import re
import secrets
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mjx_walk.logs.metrics import Row, read_rows
from mjx_walk.logs.tensorboard import EventFile
from mjx_walk.settings.config import Config, flatten
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.checksums import crc32
from mjx_walk.storage.files import Appender, read_bytes, replacing, write_text
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.utils.errors import UserError

__all__ = ["MetricsWriter", "WandbLog", "require_wandb"]

_MAX_ID_BYTES = 1000
_LOG_ROWS: Final = "log_rows"
_LOG_CHECKSUM: Final = "log_crc32"


class MetricsWriter:
    """Appends rows to `metrics.jsonl` and to TensorBoard's event file."""

    def __init__(self, run_dir: Path, resume_steps: int | None = None, position: Metadata | None = None):
        """
        Args:
            run_dir: the run folder.
            resume_steps: environment steps at which the run resumes. Later rows of the interrupted run are dropped.
            position: `position` when the checkpoint was saved. A warning says if the rows up to there are others now.
        """
        self._run_dir = run_dir
        self._path = run_dir / "metrics.jsonl"
        self._num_rows, self._checksum = 0, 0
        if resume_steps is not None:
            self._drop_later_rows(resume_steps, position or {})
        self._folder = os.stat(run_dir)
        self._file = Appender(self._path)
        self._events = EventFile(run_dir, resume_steps)

    @property
    def position(self) -> Metadata:
        """Number and checksum of the rows so far, as metadata of a checkpoint."""
        return {_LOG_ROWS: self._num_rows, _LOG_CHECKSUM: self._checksum}

    def write(self, row: Row) -> None:
        """Write one row. `env_steps` is its position on the horizontal axis.

        Raises:
            OSError: the run folder has vanished, or the row cannot be written.
        """
        if not self._file.is_in_place:
            self._reopen(row)
        line = _as_line({name: value if math.isfinite(value) else None for name, value in row.items()})
        self._file.append(line)
        self._count(line)
        values = {name: value for name, value in row.items() if "/" in name and math.isfinite(value)}
        self._events.add(values, int(row["env_steps"]))

    def sync(self) -> None:
        """Wait until all rows are on the disk."""
        self._file.sync()

    def close(self) -> None:
        """Close both files."""
        self._file.close()
        self._events.close()

    def _count(self, line: bytes) -> None:
        self._num_rows += 1
        self._checksum = crc32(line, self._checksum)

    def _drop_later_rows(self, resume_steps: int, position: Metadata) -> None:
        lines = [_as_line(row) for row in read_rows(self._path) if row["env_steps"] <= resume_steps]
        for line in lines:
            self._count(line)
        expected = position.get(_LOG_ROWS, len(lines))
        if len(lines) < expected:
            warnings.warn(
                f"{self._path} has lost {expected - len(lines)} of {expected} rows up to step {resume_steps:,}; the "
                "training continues without them",
                stacklevel=4,
            )
        elif position.get(_LOG_CHECKSUM, self._checksum) != self._checksum:
            warnings.warn(f"{self._path} was changed after the run wrote it, up to step {resume_steps:,}", stacklevel=4)
        with replacing(self._path) as new:
            new.write_bytes(b"".join(lines))

    def _reopen(self, row: Row) -> None:
        """Continue in a new file if the old one was removed or replaced, but not in another folder."""
        folder = os.stat(self._run_dir)
        if not os.path.samestat(folder, self._folder):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self._run_dir))
        warnings.warn(
            f"{self._path} was removed or replaced; its rows before step {row['env_steps']:,.0f} are gone", stacklevel=4
        )
        self._file.close()
        self._file = Appender(self._path)


def _as_line(row: Mapping[str, float | None]) -> bytes:
    return f"{json.dumps(row)}\n".encode()


def require_wandb(config: Config) -> None:
    """Check that Weights & Biases can log a run, if its configuration asks for that.

    Raises:
        UserError: the package is not installed, or the user is not logged in.
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
    """The W&B run of a run folder. A resumed run continues it. `WANDB_MODE=offline` keeps it on disk."""

    def __init__(self, config: Config, folder: RunFolder):
        """
        Args:
            config: configuration with `wandb_project`.
            folder: prepared run folder. Its `wandb_id.txt` holds the ID of the W&B run.
        """
        import wandb

        file = folder.path / "wandb_id.txt"
        if not file.exists():
            write_text(file, secrets.token_hex(4))
        identity = read_bytes(file, _MAX_ID_BYTES).decode(errors="replace").strip()
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", identity):
            raise UserError(f"{file} does not hold the ID of a run of Weights & Biases; remove the file")
        self._run: Any = wandb.init(
            project=config.wandb_project,
            id=identity,
            name=f"{folder.path.parent.name}/{folder.path.name}",
            dir=str(folder.path),
            config=flatten(config),
            resume="allow",
        )

    def write(self, row: Row) -> None:
        """Log one row at its environment steps. Rows that W&B already holds for these steps stay."""
        self._run.log({name: value for name, value in row.items() if math.isfinite(value)}, step=int(row["env_steps"]))

    def close(self) -> None:
        """Wait until all rows are uploaded or on disk."""
        self._run.finish()
