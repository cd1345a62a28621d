"""The folder of a run: its paths, and the checks before a command reads it."""

import contextlib
import dataclasses
import datetime
import os
from collections.abc import Iterator
from pathlib import Path

from mjx_walk.storage.checkpoint import config_copy, find, list_steps
from mjx_walk.storage.files import user_path
from mjx_walk.storage.scores import POLICIES
from mjx_walk.utils.errors import UserError

__all__ = ["PREFIX", "RunFolder", "new_folder", "open_existing"]

PREFIX = "zoo:"
"""Start of the name of a policy that the package ships, which stands in place of a run folder."""
_MOST_IN_A_SECOND = 10_000


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths inside a run folder."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "config.yaml"

    @property
    def inputs(self) -> Path:
        """Record of the files that the run reads."""
        return self.path / "inputs.json"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def profile(self) -> Path:
        return self.path / "profile"

    def policy(self, name: str) -> Path:
        """Folder of a kept policy, one of `POLICIES`."""
        return self.checkpoints / name

    @property
    def gymnasium_scores(self) -> Path:
        return self.path / "eval_gymnasium.json"

    @property
    def lock(self) -> Path:
        """File that the training process locks."""
        return self.path / ".lock"

    @property
    def is_run(self) -> bool:
        """Whether it holds a configuration, as a file of its own or as a copy in a checkpoint."""
        return self.config.is_file() or self.config_copy() is not None

    def config_copy(self) -> Path | None:
        """The copy of the configuration in the newest checkpoint that has an undamaged one, else in a kept policy."""
        for path in self._saved():
            try:
                copy = config_copy(path)
            except ValueError:
                continue  # restoring the checkpoint reports it
            if copy:
                return copy
        return None

    def _saved(self) -> Iterator[Path]:
        """Checkpoints from the newest to the oldest, then the kept policies."""
        yield from reversed(list_steps(self.checkpoints))
        for name in POLICIES:
            path = find(self.policy(name))
            if path:
                yield path


def new_folder(above: Path) -> Path:
    """Create a folder named by the time, and by a number if another process has created one in the same second.

    Args:
        above: the folder that holds it, created if it does not exist.

    Raises:
        UserError: the folder cannot be created.
    """
    now = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    try:
        above.mkdir(parents=True, exist_ok=True)
        for suffix in ("", *(f"_{number}" for number in range(2, _MOST_IN_A_SECOND))):
            with contextlib.suppress(FileExistsError):
                (above / f"{now}{suffix}").mkdir()
                return above / f"{now}{suffix}"
    except OSError as error:
        raise UserError(f"cannot write to {above}: {error.strerror}; give run_dir=PATH of another folder") from error
    raise UserError(f"{above} has {_MOST_IN_A_SECOND} runs of this second; give run_dir=PATH")


def open_existing(path: str | Path | None) -> RunFolder:
    """Open the folder of an existing run.

    Raises:
        UserError: no path, no run at that path, a link, pipe or device inside the run, or a folder in place of a file.
    """
    if path is None:
        raise UserError("say which run: run=RUN_DIR")
    folder = RunFolder(user_path(path))
    # Links and pipes are refused before anything is read, but not in a folder that is no run.
    if os.path.lexists(folder.config) or folder.checkpoints.is_dir():
        _refuse_special_files(folder.path)
    if not folder.is_run:
        raise UserError(f"no run at '{path}': {_where_a_run_is(folder.path)}")
    for path in (folder.config, folder.inputs, folder.metrics, folder.gymnasium_scores):
        if path.is_dir():
            raise UserError(f"'{path}' is a folder, where a run has a file; remove it")
    for path in (folder.checkpoints, *map(folder.policy, POLICIES)):
        if path.is_file():
            raise UserError(f"'{path}' is a file, where a run has a folder; remove it")
    return folder


def _where_a_run_is(path: Path) -> str:
    """Advice for a path that is no run folder."""
    above = next((parent for parent in path.parents if RunFolder(parent).config.is_file()), None)
    if above:
        return f"give the run's folder, {above}"
    below = sorted(config.parent for config in path.glob("*/config.yaml")) if path.is_dir() else []
    if below:
        return f"give one of the runs in it, such as {below[-1]}"
    return "give the folder that holds its config.yaml"


def _refuse_special_files(folder: Path) -> None:
    """Refuse links, which lead elsewhere, and pipes and devices, which block a reader or never end.

    What Weights & Biases links in its own folder stays.
    """
    for directory, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            path = Path(directory, name)
            if path.is_symlink():
                raise UserError(f"'{path}' is a symbolic link; replace it by what it points to")
            if not (path.is_file() or path.is_dir()):
                raise UserError(f"'{path}' is not a regular file; remove it")
        if Path(directory) == folder:
            folders[:] = [name for name in folders if name != "wandb"]
