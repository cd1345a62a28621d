"""The checks of a run folder before a training writes into it, and its lock."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

from mjx_walk.settings.config import Config
from mjx_walk.settings.saved_config import differences, in_short, name_same_file, read_saved_config, save_config
from mjx_walk.storage.checkpoint import list_steps
from mjx_walk.storage.files import is_unfinished, refuse_links, sync
from mjx_walk.storage.locks import locked
from mjx_walk.storage.run_folder import RunFolder, new_folder, open_existing
from mjx_walk.utils.errors import UserError

__all__ = ["locked_folder", "prepared"]

_CANNOT_WRITE = "cannot write to run_dir={}: {}"


@contextlib.contextmanager
def prepared(configs: list[Config], runs: Path = Path("runs")) -> Iterator[tuple[list[RunFolder], list[Config]]]:
    """Create or check the folders of runs that train together, and lock them. Nothing is overwritten.

    All folders are checked before the first one is created, and again under their locks.

    Args:
        configs: configurations of the runs, which may differ in `seed` and `run_dir`. Without `run_dir`, a new folder
            gets their runs.
        runs: the folder for new folders.

    Yields:
        The folders, and the configurations with `run_dir` filled in.

    Raises:
        UserError: a folder holds other files or another run, is in use, or is one of several and a link. When
            resuming: the configuration differs, or the runs cannot train together.
    """
    first = configs[0]
    if first.run_dir is None:
        if first.resume:
            raise UserError("resume=true needs run_dir=PATH of the run to continue")
        new = new_folder(runs / f"{first.env.name}_{first.algo.name}")
        paths = [new if len(configs) == 1 else new / f"seed_{config.seed}" for config in configs]
        configs = [dataclasses.replace(config, run_dir=str(path)) for config, path in zip(configs, paths, strict=True)]
    folders = [RunFolder(Path(str(config.run_dir))) for config in configs]
    if len(folders) > 1:  # the user has named only the folder above them
        for folder in folders:
            refuse_links(folder.path, folder.path.parent)
    _check_all(folders, configs)
    with contextlib.ExitStack() as locks:
        for folder in folders:
            locks.enter_context(locked_folder(folder))
        _check_all(folders, configs)
        for folder, config in zip(folders, configs, strict=True):
            _create(folder, config)
        yield folders, configs


def _check_all(folders: list[RunFolder], configs: list[Config]) -> None:
    """Check that all runs may start or continue, and can train together."""
    for folder, config in zip(folders, configs, strict=True):
        _check(folder, config)
        differing = differences(configs[0], config, besides=("run_dir", "resume", "seed"))
        if differing:
            raise UserError(f"{folder.path} and {folders[0].path} differ in {in_short(differing)}; resume each alone")


@contextlib.contextmanager
def locked_folder(folder: RunFolder) -> Iterator[None]:
    """Context manager that creates a folder if there is none, and holds its lock, however its process ends.

    Raises:
        UserError: another training holds the lock, or the folder cannot be written.
    """
    with contextlib.ExitStack() as held:
        try:
            folder.path.mkdir(parents=True, exist_ok=True)
            held.enter_context(
                locked(folder.lock, f"{folder.path} is in use by another training run; wait for it, or stop it")
            )
        except OSError as error:
            raise UserError(_CANNOT_WRITE.format(folder.path, error.strerror)) from error
        yield


def _create(folder: RunFolder, config: Config) -> None:
    try:
        for path in filter(is_unfinished, folder.path.iterdir()):
            path.unlink()
        folder.checkpoints.mkdir(exist_ok=True)
        sync(folder.path.parent)
        if not config.resume:  # a resumed run saves it after it has found a checkpoint
            save_config(config, folder.config)
    except OSError as error:
        raise UserError(_CANNOT_WRITE.format(folder.path, error.strerror)) from error


def _check(folder: RunFolder, config: Config) -> None:
    """Check that a run may start or continue in a folder."""
    if folder.path.exists() and not folder.path.is_dir():
        raise UserError(f"run_dir={config.run_dir} is a file; choose another path")
    if not config.resume:
        if not _has_begun(folder):
            return
        if folder.is_run:
            raise UserError(f"run_dir={config.run_dir} holds a run already; add resume=true, or choose another path")
        raise UserError(f"run_dir={config.run_dir} exists and is not a run folder; choose another path")
    saved = read_saved_config(open_existing(folder.path))
    differing = differences(saved, config)
    moved = []  # files that may have moved; a task may also have come from Python
    if name_same_file(saved.env.reward_function, config.env.reward_function):
        moved.append("env.reward_function ")
    if not (saved.env.task and config.env.task) or name_same_file(saved.env.task, config.env.task):
        moved.append("env.task ")
    if name_same_file(saved.env.xml_file, config.env.xml_file):
        moved.append("env.xml_file ")
    differing = [text for text in differing if not text.startswith(tuple(moved))]
    if differing:
        raise UserError(
            f"{folder.path} was trained with other settings: {in_short(differing)}; "
            "give only run_dir and resume=true to continue with the saved ones, or choose another run_dir"
        )
    if folder.gymnasium_scores.exists() and not list_steps(folder.checkpoints):
        raise UserError(f"no checkpoint in {folder.checkpoints}, although the run was scored; choose another run_dir")
    if config.total_steps < saved.total_steps:
        raise UserError(f"total_steps={config.total_steps} is below this run's {saved.total_steps}; it may only grow")


def _has_begun(folder: RunFolder) -> bool:
    """Whether a folder holds more than a run leaves that ends before it has saved its configuration."""
    if not folder.path.exists():
        return False
    return any(not _is_left_over(folder, path) for path in folder.path.iterdir())


def _is_left_over(folder: RunFolder, path: Path) -> bool:
    if path.is_symlink():
        return False
    if path == folder.checkpoints:
        return path.is_dir() and not any(path.iterdir())
    is_empty = path.is_file() and path.stat().st_size == 0
    return is_unfinished(path) or (is_empty and path in (folder.config, folder.lock))
