"""The trials of a study: each one is a training in a process of its own, whose evaluations Optuna gets as they end."""

import contextlib
import dataclasses
import itertools
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_walk.experiments.job_logs import failure_reason
from mjx_walk.experiments.planned_runs import PlannedRun, start_job
from mjx_walk.experiments.search_space import SearchSpace, Value
from mjx_walk.experiments.study import StudyFolder, TakenTrial
from mjx_walk.experiments.suggestions import TICKS
from mjx_walk.experiments.trial_values import value_at
from mjx_walk.logs.metrics import read_rows
from mjx_walk.machine.signals import Interrupt
from mjx_walk.settings.config import load_config
from mjx_walk.settings.input_files import changed_input
from mjx_walk.storage import checkpoint
from mjx_walk.storage.files import check_replaceable, refuse_links
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.utils.errors import UserError

if TYPE_CHECKING:
    import optuna

__all__ = ["Tuning", "refuse_changed_files", "run_trials"]

_SECONDS_BETWEEN_LOOKS = 1.0
_SECONDS_BETWEEN_REPORTS = 30.0
_FAILURES_TO_STOP = 3
"""A study ends when its first trials all fail."""
_BY_SIGNAL = tuple(
    code for number in (signal.SIGINT, signal.SIGKILL, signal.SIGTERM) for code in (int(number), 128 + int(number))
)
"""Absolute values of the exit codes of a training that somebody has ended, or the system for want of memory."""
_MOST_INTERRUPTIONS = 2
"""Such ends after which a trial resumes. The next one fails it."""
_ADVICE = "so try a smaller num_envs or per_device=1"


@dataclasses.dataclass(frozen=True)
class Tuning:
    """How the trials of a study are chosen and trained."""

    folder: StudyFolder
    space: SearchSpace
    seeds: list[int]
    """Training seeds of each trial."""
    num_trials: int
    """Trials of the complete study."""
    sampler: str
    pruner: str
    seed: int
    """Seed of the sampler."""

    def take_trial(self, study: "optuna.Study") -> TakenTrial | None:
        """See `StudyFolder.take_trial`."""
        return self.folder.take_trial(study, self.space, self.num_trials, self.sampler, self.pruner, self.seed)

    def job(self, number: int, values: Mapping[str, Value]) -> list[PlannedRun]:
        """The runs of a trial, one for each seed.

        Raises:
            UserError: the values do not fit together.
        """
        overrides, folder = self.space.overrides(values), self.folder.trial_folder(number)
        refuse_links(folder, self.folder.path)
        config = load_config(overrides)
        configs = (dataclasses.replace(config, seed=seed, run_dir=str(folder / f"seed_{seed}")) for seed in self.seeds)
        return [PlannedRun(folder.name, tuple(overrides), config) for config in configs]


@dataclasses.dataclass
class _Training:
    """A trial whose process is running."""

    taken: TakenTrial
    job: list[PlannedRun]
    process: subprocess.Popen
    log: Path
    device: int | None
    reported: set[int]
    """Ticks that Optuna knows."""
    num_bytes: int = 0
    """Size of the metrics that were read last."""
    is_pruned: bool = False


def refuse_changed_files(folder: StudyFolder, space: SearchSpace, seeds: list[int]) -> None:
    """Check that the user's files are those of the trials so far.

    Raises:
        UserError: one has changed.
    """
    for run in (RunFolder(folder.trial_folder(0) / f"seed_{seed}") for seed in seeds):
        changed = changed_input(run, space.recipe.env)
        if changed:
            raise UserError(f"{changed} has changed since the study in {folder.path} began; choose another out=DIR")


def run_trials(
    tuning: Tuning,
    study: "optuna.Study",
    devices: list[int | None],
    on_end: Callable[[int], None],
    on_progress: Callable[[PlannedRun], None] = lambda _: None,
) -> str | None:
    """Run trials until the study is complete or a signal arrives, one at a time on each device.

    Args:
        tuning: what to run.
        study: see `StudyFolder`.
        devices: GPUs, each repeated as often as trials may share it; `[None]` for the CPU.
        on_end: called with the number of each trial that has ended.
        on_progress: called now and then with each run that is being trained.

    Returns:
        Name of the signal that stopped it early, else None. All trainings have then saved their state.

    Raises:
        UserError: the first trials have all failed.
    """
    free = list(devices)
    share = len(devices) // len(set(devices))
    running: list[_Training] = []
    last_report = time.monotonic()
    with Interrupt("the trials are saving") as interrupt:
        try:
            while not interrupt.signal_name:
                while free and (taken := tuning.take_trial(study)):
                    training = _start(tuning, study, taken, free[0], share)
                    if training:
                        running.append(training)
                        free.pop(0)
                    else:
                        _has_ended(taken.trial.number, tuning, study, on_end, running)
                if not running:
                    break
                time.sleep(_SECONDS_BETWEEN_LOOKS)
                for training in list(running):
                    has_ended = training.process.poll() is not None  # asked first: all that it wrote is read then
                    _report(training, has_ended)
                    if has_ended and not interrupt.signal_name:  # the signal may have ended it, too: it resumes
                        running.remove(training)
                        free.append(training.device)
                        _end(study, training.taken, training.job, training)
                        _has_ended(training.taken.trial.number, tuning, study, on_end, running)
                if time.monotonic() - last_report > _SECONDS_BETWEEN_REPORTS:
                    last_report = time.monotonic()
                    for run in itertools.chain.from_iterable(training.job for training in running):
                        on_progress(run)
        finally:  # after an error, too, no training may outlive this process
            for training in running:
                training.process.send_signal(signal.SIGTERM)
            for training in running:
                training.process.wait()
                if training.is_pruned:
                    _end(study, training.taken, training.job, training)
                training.taken.release.close()
    return interrupt.signal_name


def _start(
    tuning: Tuning, study: "optuna.Study", taken: TakenTrial, device: int | None, share: int
) -> _Training | None:
    """Start the process of a trial. None for a trial that ends at once, because it is complete or invalid."""
    trial, job = taken.trial, []
    log = tuning.folder.logs / f"trial_{trial.number:04d}.txt"
    try:
        job = tuning.job(trial.number, trial.params)
        if all(run.is_finished for run in job):
            _end(study, taken, job)
            return None
        refuse_links(log, log.parent)
        check_replaceable(log)
        job.sort(key=lambda run: run.steps_saved or 0)  # if one of them has saved nothing, all begin again
        process = start_job(job, log, device, share, taken.lock, ends_with_parent=True)
    except UserError as error:
        _fail(study, taken, job, str(error))
        return None
    reported = set(study.get_trials(deepcopy=False)[trial.number].intermediate_values)
    return _Training(taken, job, process, log, device, reported)


def _report(training: _Training, has_ended: bool) -> None:
    """Report the evaluations that are new, and stop a trial that is to be pruned. The recipe's own is never pruned."""
    files = [run.folder.metrics for run in training.job]
    num_bytes = sum(file.stat().st_size for file in files if file.exists())
    if training.is_pruned or num_bytes == training.num_bytes:
        return
    training.num_bytes = num_bytes
    trial, logs = training.taken.trial, [read_rows(file) for file in files]
    for tick in range(1, TICKS + 1):
        value = value_at(logs, training.job[0].config.total_steps, tick)
        if value is None or tick in training.reported:
            continue
        trial.report(value, tick)
        training.reported.add(tick)
        is_bad = trial.should_prune()  # asked for the recipe, too: others are compared with it
        if is_bad and trial.number > 0 and not has_ended:
            training.is_pruned = True
            training.process.send_signal(signal.SIGTERM)
            return


def _end(study: "optuna.Study", taken: TakenTrial, job: list[PlannedRun], training: _Training | None = None) -> None:
    """Tell Optuna how a trial has ended, and remove what only a resume needs."""
    from optuna.trial import TrialState

    trial, logs = taken.trial, [read_rows(run.folder.metrics) for run in job]
    value = value_at(logs, job[0].config.total_steps)
    seconds = [rows[-1]["wall_seconds"] for rows in logs if rows]
    if seconds:
        trial.set_user_attr("seconds", max(seconds))
    if all(run.is_finished for run in job):
        if value is None:
            steps = job[0].config.total_steps
            _fail(study, taken, job, f"no evaluation of a trained policy ended within total_steps={steps}; raise it")
            return
        study.tell(trial, value)
    elif training and training.is_pruned:
        study.tell(trial, state=TrialState.PRUNED)
    else:
        assert training
        code, interruptions = training.process.returncode, trial.user_attrs.get("interruptions", 0)
        if abs(code) in _BY_SIGNAL and interruptions < _MOST_INTERRUPTIONS:
            trial.set_user_attr("interruptions", interruptions + 1)
            taken.release.close()  # the next look finds it without a process, and resumes it
            return
        by_signal = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        reason = failure_reason(training.log, _ADVICE) or by_signal
        _fail(study, taken, job, f"{reason}; see {training.log}")
        return
    _remove_checkpoints(job)
    taken.release.close()


def _remove_checkpoints(job: list[PlannedRun]) -> None:
    """Remove what only a resume needs. The kept policies stay."""
    for run in job:
        for path in checkpoint.list_steps(run.folder.checkpoints):
            with contextlib.suppress(OSError):
                shutil.rmtree(path)


def _fail(study: "optuna.Study", taken: TakenTrial, job: list[PlannedRun], reason: str) -> None:
    from optuna.trial import TrialState

    taken.trial.set_user_attr("reason", reason)
    study.tell(taken.trial, state=TrialState.FAIL)
    _remove_checkpoints(job)
    taken.release.close()


def _has_ended(
    number: int,
    tuning: Tuning,
    study: "optuna.Study",
    on_end: Callable[[int], None],
    running: list[_Training],
) -> None:
    """Say that a trial has ended. Stop the study if nothing but failures has ended and nothing else is running."""
    from optuna.trial import TrialState

    if not study.get_trials(deepcopy=False)[number].state.is_finished():
        return  # it was interrupted, and resumes
    on_end(number)
    ended = [trial.state for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]
    if not running and len(ended) >= _FAILURES_TO_STOP and set(ended) == {TrialState.FAIL}:
        folder = tuning.folder.path
        raise UserError(f"the first {len(ended)} trials have all failed; remove {folder}, and correct the command")
