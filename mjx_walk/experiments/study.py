"""A study of Optuna in a folder: its storage, its facts, and the trials that a process takes."""

import contextlib
import dataclasses
import logging
import threading
import time
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_walk.experiments.search_space import SearchSpace
from mjx_walk.experiments.suggestions import make_pruner, make_sampler, with_values
from mjx_walk.settings.config import flatten, load_recipe
from mjx_walk.settings.recipe_files import recipe_file
from mjx_walk.settings.saved_config import differing_values, in_short
from mjx_walk.storage.files import check_replaceable, refuse_links
from mjx_walk.storage.locks import locked
from mjx_walk.utils.errors import UserError, first_line

if TYPE_CHECKING:
    import optuna

__all__ = ["Facts", "StudyFolder", "TakenTrial", "facts_of", "require_optuna"]

_LOGGER = logging.getLogger(__name__)
_NAME = "mjx_walk"
"""Name of the study, and of the attribute that holds its facts."""
_CHOOSE_RECIPE = ("hardware", "env", "env.task", "algo", "recipe")
_OF_A_TRIAL = ("run_dir", "resume", "evaluation.gymnasium_episodes")
"""Settings of trials that no recipe has."""
_BUSY = "in use"
_SILENT_SECONDS = 2.0
"""Wait for the journal's lock without a message. A process holds it for the time of a write."""
_STALE_SECONDS = 30
"""Optuna removes a lock that is this old."""


def require_optuna() -> None:
    """Check that Optuna is installed, and silence its log messages.

    Raises:
        UserError: it is not.
    """
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise UserError("Optuna is missing: pip install 'mjx-walk[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)


@dataclasses.dataclass(frozen=True)
class Facts:
    """What a study is about, as JSON. All processes that work on it must agree."""

    settings: dict[str, Any]
    """The recipe's settings by their full keys."""
    ranges: dict[str, str]
    """The searched settings with their values, as a command line has them."""
    seeds: list[int]
    """Training seeds of each trial."""
    recipe: str
    """Name or path of the recipe."""
    chosen: list[str]
    """Overrides that choose the task and the algorithm."""
    changes: dict[str, Any]
    """Settings in which all trials differ from the recipe, by their full keys."""


def facts_of(space: SearchSpace, seeds: list[int]) -> Facts:
    """The facts of a study.

    Args:
        space: what it searches.
        seeds: training seeds of each trial.
    """
    given = dict(text.split("=", 1) for text in space.fixed)
    env, algo = space.recipe.env.name, space.recipe.algo.name
    chosen = [f"env.task={space.recipe.env.task}" if "env.task" in given else f"env={env}", f"algo={algo}"]
    chosen += [f"hardware={space.recipe.hardware}"] if "hardware" in given else []
    choosing = [text for text in space.fixed if text.partition("=")[0] in _CHOOSE_RECIPE]
    settings = flatten(space.recipe)
    plain = load_recipe(choosing, space.recipe.total_steps)
    changes = {key: value for key, value in settings.items() if value != plain.get(key) and key not in _OF_A_TRIAL}
    name = given.get("recipe", "").strip("'") or f"{space.recipe.hardware}/{env}_{algo}"
    ranges = {key: str(values) for key, values in space.ranges.items()}
    return Facts(settings, ranges, seeds, str(recipe_file(name) or name), chosen, changes)


@dataclasses.dataclass(frozen=True)
class TakenTrial:
    """A trial that this process works on."""

    trial: "optuna.Trial"
    lock: int
    """File descriptor that keeps other processes from taking it."""
    release: contextlib.ExitStack = dataclasses.field(repr=False)
    """Closing it releases the lock."""


class _JournalLock:
    """Optuna's lock of the journal. A wait for it is logged, since a killed process leaves its lock behind."""

    def __init__(self, journal: Path):
        from optuna.storages.journal import JournalFileOpenLock

        self._file = f"{journal}.lock"
        self._lock = JournalFileOpenLock(str(journal), _STALE_SECONDS)

    def acquire(self) -> bool:
        says = "waiting up to %d s for the process that holds %s; if no other one works on this study, delete that file"
        notice = threading.Timer(_SILENT_SECONDS, _LOGGER.warning, (says, _STALE_SECONDS, self._file))
        notice.start()
        try:
            return self._lock.acquire()
        finally:
            notice.cancel()

    def release(self) -> None:
        self._lock.release()


class StudyFolder:
    """The folder of a study, which several processes share."""

    def __init__(self, path: Path):
        """
        Args:
            path: of the folder.
        """
        self.path = path

    @property
    def storage(self) -> Path:
        """Optuna's journal: a line of JSON for each event."""
        return self.path / "study.log"

    @property
    def logs(self) -> Path:
        """Folder for the output of trainings, and for locks."""
        return self.path / "logs"

    def trial_folder(self, number: int) -> Path:
        """The folder of a trial's runs."""
        return self.path / f"trial_{number:04d}"

    def open(self) -> "optuna.Study":
        """Open an existing study.

        Raises:
            UserError: there is none, or it cannot be read.
        """
        if not self.storage.is_file():
            raise UserError(f"no study in '{self.path}'; give out=DIR of a folder with a {self.storage.name}")
        return self._load(create=False)

    def create_or_open(self, facts: Facts) -> "optuna.Study":
        """Open a study, and create it if it does not exist.

        Raises:
            UserError: the folder holds a study with other facts, or cannot be written to.
        """
        refuse_links(self.logs, self.path)
        try:
            self.logs.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot write to {self.path}: {error.strerror}; choose another out=DIR") from error
        with self._alone():
            self._mend()
            study = self._load(create=True)
            if _NAME not in study.user_attrs:
                study.set_user_attr(_NAME, dataclasses.asdict(facts))
        _refuse_other(self.facts(study), facts, self.path)
        return study

    def _mend(self) -> None:
        """Remove a last line that a full disk has left incomplete. Optuna would append to it."""
        refuse_links(self.storage, self.path)
        if not self.storage.is_file():
            return
        lock = _JournalLock(self.storage)
        lock.acquire()
        try:
            with self.storage.open("rb+") as file:
                content = file.read()
                file.truncate(content.rfind(b"\n") + 1)
        except OSError as error:
            raise UserError(f"cannot read or write {self.storage}: {error.strerror}") from error
        finally:
            lock.release()

    def _load(self, create: bool) -> "optuna.Study":
        from optuna import create_study, load_study
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        refuse_links(self.storage, self.path)
        check_replaceable(self.storage)
        name, lock = str(self.storage), typing.cast(Any, _JournalLock(self.storage))
        try:
            storage = JournalStorage(JournalFileBackend(name, lock))
            if create:
                return create_study(storage=storage, study_name=_NAME, direction="maximize", load_if_exists=True)
            return load_study(storage=storage, study_name=_NAME)
        except OSError as error:
            raise UserError(f"cannot read or write {name}: {error.strerror}") from error
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise UserError(f"{name} is not the log of a study: {first_line(error)}; choose another out=DIR") from error

    def facts(self, study: "optuna.Study") -> Facts:
        """The facts that a study was created with.

        Raises:
            UserError: it has none, because another program has created it.
        """
        try:
            facts = Facts(**study.user_attrs[_NAME])
        except (KeyError, TypeError) as error:
            raise UserError(f"{self.storage} holds a study of another program; choose another out=DIR") from error
        kinds = typing.get_type_hints(Facts).items()
        if not all(isinstance(getattr(facts, name), typing.get_origin(kind) or kind) for name, kind in kinds):
            raise UserError(f"{self.storage} holds a study of another program; choose another out=DIR")
        return facts

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Context manager in which no other process takes a trial. It waits for its turn."""
        with contextlib.ExitStack() as held:
            while True:
                try:
                    held.enter_context(locked(self.logs / "lock", _BUSY))
                    break
                except UserError:
                    time.sleep(0.05)
            yield

    def take_trial(
        self, study: "optuna.Study", space: SearchSpace, num_trials: int, sampler: str, pruner: str, seed: int
    ) -> TakenTrial | None:
        """Take an interrupted trial whose process has ended, or else a new one.

        The first trial of a study has the recipe's own values, as far as the ranges contain them.

        Args:
            study: the study.
            space: what it searches.
            num_trials: trials of the complete study.
            sampler: one of `suggestions.SAMPLERS`.
            pruner: one of `suggestions.PRUNERS`.
            seed: with the trial's number, the seed of the sampler.

        Returns:
            The trial, or None if all trials have ended or other processes work on them.
        """
        from optuna import Trial
        from optuna.trial import TrialState

        study.pruner = make_pruner(pruner)
        with self._alone():
            trials = study.get_trials(deepcopy=False)
            for frozen in trials:
                held = self._lock_trial(frozen.number) if frozen.state == TrialState.RUNNING else None
                if not held:
                    continue
                if study.get_trials(deepcopy=False)[frozen.number].state == TrialState.RUNNING:
                    study.sampler = make_sampler(sampler, seed, frozen.number)
                    return TakenTrial(with_values(Trial(study, frozen._trial_id), space), *held)
                held[1].close()  # it has ended since the trials were read
            begun = [frozen for frozen in trials if frozen.state != TrialState.WAITING]
            if len(begun) >= num_trials:
                return None
            study.sampler = make_sampler(sampler, seed, len(begun))
            if not begun:
                study.enqueue_trial(space.recipe_values, skip_if_exists=True)
            trial = study.ask()
            held = self._lock_trial(trial.number)
            assert held, "nobody else knows this trial yet"
            return TakenTrial(with_values(trial, space), *held)

    def _lock_trial(self, number: int) -> tuple[int, contextlib.ExitStack] | None:
        """The lock of a trial, which the training process holds as well. None if it is taken."""
        with contextlib.ExitStack() as held:
            try:
                descriptor = held.enter_context(locked(self.logs / f"trial_{number:04d}.lock", _BUSY))
            except UserError:
                return None
            return descriptor, held.pop_all()


def _refuse_other(saved: Facts, asked: Facts, folder: Path) -> None:
    """Refuse a study with other facts."""
    old, new = (
        {**facts.settings, **{f"search {k}": v for k, v in facts.ranges.items()}, "seeds": facts.seeds}
        for facts in (saved, asked)
    )
    differing = differing_values(old, new)
    if differing:
        raise UserError(f"{folder} holds a study with other settings ({in_short(differing)}); choose another out=DIR")
