"""The folder of a run: its paths, and the checks before a run writes into it."""

import dataclasses
import datetime
import os
from pathlib import Path

from mjx_walk.runs.checkpoint import list_steps
from mjx_walk.runs.config import Config, flatten, read_config, save_config
from mjx_walk.runs.scores import BEST, FINAL
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.files import user_path

__all__ = ["MAY_DIFFER", "RunFolder", "differences", "in_short", "new_path", "open_existing", "prepare"]

MAY_DIFFER = (
    *("run_dir", "resume", "total_steps", "algo.schedule_steps"),
    *("wandb_project", "evaluation.films", "profile_calls"),
)
"""Settings that may change when a run is resumed."""
_CHOOSE_RECIPE = ("env.name", "algo.name", "hardware")
"""Settings that choose a recipe, from which many others follow."""
_MOST_NAMED = 5
"""Most differences that a message names."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths inside a run folder."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "config.yaml"

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
        """Folder of a kept policy, `final` or `best`."""
        return self.checkpoints / name

    @property
    def gymnasium_scores(self) -> Path:
        return self.path / "eval_gymnasium.json"


def new_path(config: Config) -> Path:
    """The default folder of a new run."""
    now = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return Path("runs") / f"{config.env.name}_{config.algo.name}" / now


def open_existing(path: str | Path | None) -> RunFolder:
    """Open the folder of an existing run.

    Raises:
        UserError: no path, no run at that path, a link, pipe or device inside the run, or a folder in place of a file.
    """
    if path is None:
        raise UserError("say which run: run=RUN_DIR")
    folder = RunFolder(user_path(path))
    if not folder.config.is_file():
        raise UserError(f"no run at '{path}': give the folder that holds its config.yaml")
    _refuse_special_files(folder.path)
    for path in (folder.metrics, folder.gymnasium_scores):
        if path.is_dir():
            raise UserError(f"'{path}' is a folder, where a run has a file; remove it")
    for path in (folder.checkpoints, folder.policy(FINAL), folder.policy(BEST)):
        if path.is_file():
            raise UserError(f"'{path}' is a file, where a run has a folder; remove it")
    return folder


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


def prepare(configs: list[Config]) -> tuple[list[RunFolder], list[Config]]:
    """Create or check the folders of runs that train together. Nothing is overwritten.

    All folders are checked before the first one is created.

    Args:
        configs: configurations of the runs, which may differ in `seed` and `run_dir`.

    Returns:
        The folders, and the configurations with `run_dir` filled in.

    Raises:
        UserError: a folder holds other files or another run. When resuming: the configuration differs, or the runs
            cannot train together.
    """
    first = configs[0]
    if first.run_dir is None:
        if first.resume:
            raise UserError("resume=true needs run_dir=PATH of the run to continue")
        configs = [dataclasses.replace(config, run_dir=str(new_path(config))) for config in configs]
    folders = [RunFolder(Path(str(config.run_dir))) for config in configs]
    for folder, config in zip(folders, configs, strict=True):
        _check(folder, config)
        differing = differences(first, config, besides=("run_dir", "resume", "seed"))
        if differing:
            raise UserError(f"{folder.path} and {folders[0].path} differ in {in_short(differing)}; resume each alone")
    steps = {_newest(folder) for folder in folders}
    if len(steps) > 1:
        raise UserError(f"the seeds are at different steps ({', '.join(sorted(steps))}); resume each alone")
    for folder, config in zip(folders, configs, strict=True):
        try:
            folder.checkpoints.mkdir(parents=True, exist_ok=config.resume)
            if not config.resume:  # a resumed run saves it after it has found a checkpoint
                save_config(config, folder.config)
        except OSError as error:
            raise UserError(f"cannot write to run_dir={config.run_dir}: {error.strerror}") from error
    return folders, configs


def differences(saved: Config, config: Config, besides: tuple[str, ...] = MAY_DIFFER) -> list[str]:
    """The settings in which two configurations differ, with both values, for messages.

    Args:
        saved: the former configuration.
        config: the present one.
        besides: keys to ignore.
    """
    old, new = flatten(saved), flatten(config)
    return [
        f"{key} (was {old.get(key)}, now {new.get(key)})"
        for key in sorted(old.keys() | new.keys())
        if key not in besides and old.get(key) != new.get(key)
    ]


def in_short(differing: list[str]) -> str:
    """One line that names a few differences, and counts the others.

    If there are many, it names those that choose the recipe: the others mostly follow from them.

    Args:
        differing: see `differences`.
    """
    choosing = [text for text in differing if text.partition(" ")[0] in _CHOOSE_RECIPE]
    named = differing if len(differing) <= _MOST_NAMED else choosing or differing[:_MOST_NAMED]
    num_others = len(differing) - len(named)
    return "; ".join([*named, *([f"and {num_others} more"] if num_others else [])])


def _check(folder: RunFolder, config: Config) -> None:
    """Check that a run may start or continue in a folder."""
    if folder.path.exists() and not folder.path.is_dir():
        raise UserError(f"run_dir={config.run_dir} is a file; choose another path")
    if not config.resume:
        if folder.config.exists():
            raise UserError(f"run_dir={config.run_dir} holds a run already; add resume=true, or choose another path")
        if folder.path.exists() and any(folder.path.iterdir()):
            raise UserError(f"run_dir={config.run_dir} exists and is not a run folder; choose another path")
        return
    saved = read_config(open_existing(folder.path).config)
    differing = differences(saved, config)
    moved = []  # files that may have moved; a task may also have come from Python
    if _name_same(saved.env.reward_function, config.env.reward_function):
        moved.append("env.reward_function ")
    if not (saved.env.task and config.env.task) or _name_same(saved.env.task, config.env.task):
        moved.append("env.task ")
    differing = [text for text in differing if not text.startswith(tuple(moved))]
    if differing:
        raise UserError(
            f"resume=true with another configuration than {folder.config}: {in_short(differing)}; "
            "with run_dir and resume=true alone it continues with the saved settings"
        )
    if folder.gymnasium_scores.exists() and not list_steps(folder.checkpoints):
        raise UserError(f"no checkpoint in {folder.checkpoints}, although the run was scored; choose another run_dir")
    if config.total_steps < saved.total_steps:
        raise UserError(f"total_steps={config.total_steps} is below this run's {saved.total_steps}; it may only grow")


def _name_same(source: str | None, other: str | None) -> bool:
    """Whether two `PATH.py:NAME` differ at most in the folder of the file."""
    return bool(source and other) and Path(str(source)).name == Path(str(other)).name


def _newest(folder: RunFolder) -> str:
    """The environment steps of the newest checkpoint."""
    saved = list_steps(folder.checkpoints)
    return f"{int(saved[-1].name):,}" if saved else "0"
