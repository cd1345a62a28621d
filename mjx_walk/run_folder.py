"""The folder of a run: what belongs where, and who may write into it."""

import dataclasses
import datetime
from pathlib import Path

from mjx_walk.config import Config, flatten, read_config, save_config
from mjx_walk.errors import UserError

MAY_DIFFER = ("run_dir", "resume", "total_steps")
"""Keys that a resumed run may be given anew."""


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
    def best_policy(self) -> Path:
        return self.checkpoints / "best"

    @property
    def gymnasium_scores(self) -> Path:
        return self.path / "eval_gymnasium.json"


def new_path(config: Config) -> Path:
    """Where a run goes if nothing is said."""
    now = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return Path("runs") / f"{config.env.name}_{config.algo.name}" / now


def open_existing(path: str | Path) -> RunFolder:
    """A folder that a run has written.

    Raises:
        UserError: there is no run at that path.
    """
    folder = RunFolder(Path(path))
    if not folder.config.is_file():
        raise UserError(f"no run at '{path}': give the folder that holds its config.yaml")
    return folder


def prepare(config: Config) -> tuple[RunFolder, Config]:
    """The folder to train in, made or resumed. Nothing that is there is overwritten.

    Returns:
        The folder, and the configuration with `run_dir` filled in.

    Raises:
        UserError: the folder holds something else, or another run; or, to resume, another configuration.
    """
    if config.run_dir is None:
        if config.resume:
            raise UserError("resume=true needs run_dir=PATH of the run to go on with")
        config = dataclasses.replace(config, run_dir=str(new_path(config)))
    folder = RunFolder(Path(str(config.run_dir)))
    if folder.path.exists() and not folder.path.is_dir():
        raise UserError(f"run_dir={config.run_dir} is a file; choose another path")
    if config.resume:
        return folder, _check_same_run(open_existing(folder.path), config)
    if folder.config.exists():
        raise UserError(f"run_dir={config.run_dir} holds a run already; add resume=true, or choose another path")
    if folder.path.exists() and any(folder.path.iterdir()):
        raise UserError(f"run_dir={config.run_dir} exists and is not a run folder; choose another path")
    try:
        folder.checkpoints.mkdir(parents=True)
        save_config(config, folder.config)
    except OSError as error:
        raise UserError(f"cannot write to run_dir={config.run_dir}: {error.strerror}") from error
    return folder, config


def differences(saved: Config, config: Config) -> list[str]:
    """The settings in which a run differs from what is asked for now, beside those that may."""
    old, new = flatten(saved), flatten(config)
    return [
        f"{key} (was {old.get(key)}, now {new.get(key)})"
        for key in sorted(old.keys() | new.keys())
        if key not in MAY_DIFFER and old.get(key) != new.get(key)
    ]


def _check_same_run(folder: RunFolder, config: Config) -> Config:
    saved = read_config(folder.config)
    differing = differences(saved, config)
    if differing:
        raise UserError(f"resume=true with another configuration than {folder.config}: {'; '.join(differing)}")
    if config.total_steps < saved.total_steps:
        raise UserError(f"total_steps={config.total_steps} is below this run's {saved.total_steps}; it may only grow")
    save_config(config, folder.config)
    return config
