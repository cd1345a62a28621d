"""The checks before a training: what a resumed run may change, memory, disk space, and the run folder with its lock."""

import contextlib
import dataclasses
import operator
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

from mjx_walk.algos import Algorithm
from mjx_walk.envs.user_files import only_known, source_path
from mjx_walk.machine.devices import device_memory, num_bytes
from mjx_walk.settings.config import Config
from mjx_walk.settings.input_files import check_inputs
from mjx_walk.settings.renamed import present_key
from mjx_walk.settings.saved_config import (
    differences,
    in_short,
    name_same_file,
    read_saved_config,
    save_config,
    with_setting,
)
from mjx_walk.settings.trust import require_trusted
from mjx_walk.storage.checkpoint import list_steps
from mjx_walk.storage.files import is_unfinished, refuse_links, sync
from mjx_walk.storage.locks import locked
from mjx_walk.storage.run_folder import RunFolder, new_folder, open_existing
from mjx_walk.utils.errors import UserError

__all__ = ["as_saved", "check_replay", "locked_folder", "prepared"]

_CANNOT_WRITE = "cannot write to run_dir={}: {}"
_USABLE = 0.9
"""Maximum fraction of the device's memory for the replay buffer."""


def as_saved(config: Config, overrides: list[str]) -> Config:
    """The saved configuration with the given settings, if a run is resumed without naming its task or algorithm.

    Raises:
        UserError: a file that the run reads has changed; or the saved run has a reward function that neither the
            overrides name nor the user has named before, or logs to Weights & Biases, and the overrides do not say so.
            A folder must not run code or upload.
    """
    if config.env.reward_function:
        only_known(source_path(config.env.reward_function), None)
    given = {present_key(override.partition("=")[0]) for override in overrides}
    if not (config.resume and config.run_dir):
        return config
    if given & {"env", "algo", "recipe"}:
        check_inputs(RunFolder(Path(config.run_dir)), config.env, config.env)
        return config
    folder = open_existing(config.run_dir)
    saved = read_saved_config(folder)
    source = saved.env.reward_function
    if source and "env.reward_function" not in given:
        require_trusted(source)
    check_inputs(folder, saved.env, config.env)
    project = saved.wandb_project
    if project and "wandb_project" not in given:
        named = shlex.quote(f"wandb_project={project}")
        raise UserError(f"the saved run logs to Weights & Biases; to continue, add {named}, or wandb_project=null")
    for key in given - {"hardware"} | {"run_dir", "resume"}:
        saved = with_setting(saved, key, operator.attrgetter(key)(config))
    return saved


def check_replay(algorithm: Algorithm, run_dir: Path, num_runs: int = 1) -> str | None:
    """Memory and disk space that the replay buffer needs, as a line to print.

    Args:
        algorithm: the algorithm, with its replay size.
        run_dir: run folder; it need not exist.
        num_runs: number of seeds in one process.

    Returns:
        One line, or None if the algorithm has no replay buffer.

    Raises:
        UserError: the replay buffer or its checkpoints do not fit.
    """
    if not algorithm.replay_bytes:
        return None
    replay_bytes = num_runs * algorithm.replay_bytes
    checkpoint_bytes = num_runs * num_bytes(algorithm.state_shapes())
    replay, disk = f"{replay_bytes / 1e9:,.2f} GB", f"{2 * checkpoint_bytes / 1e9:,.2f} GB"
    memory = device_memory()
    if replay_bytes > _USABLE * memory:
        fewer = " or train fewer seeds in one process (compare: together=1)" if num_runs > 1 else ""
        raise UserError(
            f"the replay buffer needs {replay}, but the device has {memory / 1e9:,.2f} GB; "
            f"lower algo.replay_capacity{fewer}"
        )
    existing = next(path for path in (run_dir.absolute(), *run_dir.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if 2 * checkpoint_bytes > free:
        raise UserError(
            f"checkpoints with the replay buffer need {disk} of disk space, but {existing} has "
            f"{free / 1e9:,.2f} GB free; lower algo.replay_capacity or choose another run_dir"
        )
    return f"Replay buffer: {replay} of device memory, and up to {disk} of disk space while a checkpoint is replaced."


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
    """Whether a folder holds files other than those of a run that ended before it saved its configuration."""
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
