"""The planned runs of a comparison: each variant with each seed is one training run, in its own folder."""

import contextlib
import dataclasses
import itertools
import os
import re
import shutil
import signal
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser

from mjx_walk.envs import TASKS
from mjx_walk.logs.metrics import read_rows
from mjx_walk.machine.devices import only_device
from mjx_walk.machine.signals import Interrupt
from mjx_walk.machine.subprocesses import start_module, with_parent
from mjx_walk.settings.config import Config, load_config
from mjx_walk.settings.input_files import changed_input
from mjx_walk.settings.overrides import complete_overrides, sweep_choices
from mjx_walk.settings.saved_config import differences, in_short, read_saved_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.files import check_replaceable, open_to_append, refuse_links, user_path
from mjx_walk.storage.locks import locked
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.checks import locked_folder
from mjx_walk.training.goal import has_reached
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import format_score

__all__ = ["PlannedRun", "jobs", "most_together", "plan", "run_jobs", "start_job"]

_SECONDS_BETWEEN_REPORTS = 30.0
_MEMORY_FRACTION = 0.75
"""Share of a GPU's memory that JAX allocates at its start by default."""


@dataclasses.dataclass(frozen=True)
class PlannedRun:
    """One run of a comparison."""

    variant: str
    """Algorithm and swept values, as a folder name: `ppo`, `ppo_learning_rate-0.001`; in a suite, `ant/ppo`."""
    overrides: tuple[str, ...]
    """Settings of the variant, without the seed and the folder."""
    config: Config
    """All settings of the run."""

    @property
    def folder(self) -> RunFolder:
        return RunFolder(Path(str(self.config.run_dir)))

    @property
    def name(self) -> str:
        return f"{self.variant}/seed_{self.config.seed}"

    @property
    def steps_saved(self) -> int | None:
        """Environment steps of its newest checkpoint, if it has one."""
        saved = checkpoint.list_steps(self.folder.checkpoints)
        return int(saved[-1].name) if saved else None

    @property
    def is_finished(self) -> bool:
        """Whether it has logged all its steps or reached its goal, and been scored if its settings ask for that."""
        rows = read_rows(self.folder.metrics) if self.folder.is_run else []
        is_long_enough = bool(rows) and rows[-1]["env_steps"] >= self.config.total_steps
        if not (is_long_enough or has_reached(rows, self.config.stop_at_return)):
            return False
        return not self.config.evaluation.gymnasium_episodes or self.folder.gymnasium_scores.exists()

    @property
    def progress(self) -> str:
        """Steps so far and the last return, in words."""
        rows = read_rows(self.folder.metrics)
        if not rows:
            return "starting"
        returns = [row["episode/return"] for row in rows if row.get("episode/return") is not None]
        text = f"{rows[-1]['env_steps'] / 1e6:.2f} of {self.config.total_steps / 1e6:.2f} million steps"
        return text + (f", return {format_score(returns[-1])}" if returns else "")


def plan(
    overrides: list[str], algos: list[str], seeds: list[int], out: str | None, hardware: str
) -> tuple[Path, list[PlannedRun]]:
    """Plan the runs of a comparison, and check all of them before the first one starts.

    Args:
        overrides: as for `train`; a comma makes variants, `algo.learning_rate=1e-3,3e-4`.
        algos: algorithms.
        seeds: seeds.
        out: folder of the comparison; by default `runs/compare_ENV`.
        hardware: `gpu` or `cpu`, the size of the recipes.

    Returns:
        The folder and the runs.

    Raises:
        UserError: any run has an invalid setting, or its folder holds another run or is a link.
    """
    choices = [[f"algo={algo}" for algo in algos], *_choices(overrides, hardware)]
    first = load_config([options[0] for options in choices])
    folder = user_path(out or f"runs/compare_{first.env.name}")
    if "${" in str(folder):
        raise UserError(f"out={folder}: '${{' names another setting; choose a name without it")
    runs: dict[str, PlannedRun] = {}
    for seed, chosen in itertools.product(seeds, itertools.product(*choices)):
        swept = [text for text, options in zip(chosen[1:], choices[1:], strict=True) if len(options) > 1]
        texts = (text.removeprefix("algo").lstrip("=.").replace("'", "") for text in (chosen[0], *swept))
        parts = (text.replace("=", "-") for text in texts)
        variant = "_".join(re.sub(r"[^\w.+-]+", "_", part) for part in parts)
        run_dir = folder / variant / f"seed_{seed}"
        refuse_links(run_dir, folder)
        config = dataclasses.replace(load_config(list(chosen)), seed=seed, run_dir=str(run_dir))
        run = PlannedRun(variant, chosen, config)
        if runs.setdefault(run.name, run).config != run.config:
            raise UserError(f"two variants would share the folder {run_dir}; compare them in two comparisons")
    environments = {f"{run.config.env.name} {run.config.env.version}" for run in runs.values()}
    if len(environments) > 1:
        raise UserError(f"a comparison has one environment; these are several: {', '.join(sorted(environments))}")
    for run in runs.values():
        _check_same_configuration(run)
    return folder, list(runs.values())


def _choices(overrides: list[str], hardware: str) -> list[list[str]]:
    """The alternatives of each override: several for one with commas, else one."""
    reserved = {"algo": "write 'algos=[{}]'", "seed": "write seeds=[{}]", "run_dir": "write out={}"}
    reserved["resume"] = "leave it out, since finished and interrupted runs are kept"
    choices = []
    completed = complete_overrides([f"hardware={hardware}", *overrides], is_sweep=True)
    for override in OverridesParser.create().parse_overrides(completed):
        key, text = override.key_or_group, str(override.input_line)
        if key in reserved:
            raise UserError(f"'{text}': in a comparison {reserved[key].format(text.partition('=')[2])}")
        if key == "env" and override.is_sweep_override():
            raise UserError(f"'{text}': a comparison has one environment; give one of them, or suite=mujoco for all")
        if override.is_sweep_override() and not override.is_choice_sweep():
            raise UserError(f"'{text}': list the values, {key}=A,B")
        is_swept = override.is_sweep_override()
        choices.append(sweep_choices(override) if is_swept else [text])
    return choices


def _check_same_configuration(run: PlannedRun) -> None:
    if not run.folder.is_run:
        return
    saved = read_saved_config(run.folder)
    physics = TASKS[run.config.env.name][0].resolve_physics(run.config.physics)
    differing = differences(saved, dataclasses.replace(run.config, physics=physics))
    if run.config.total_steps < saved.total_steps:
        differing.append("total_steps, which may only grow")
    if differing:
        raise UserError(
            f"{run.folder.path} holds a run with other settings ({in_short(differing)}); choose another out=DIR"
        )
    changed = changed_input(run.folder, run.config.env)
    if changed:
        raise UserError(f"{changed} has changed since {run.folder.path} was trained; choose another out=DIR")


def jobs(runs: list[PlannedRun], together: int) -> list[list[PlannedRun]]:
    """Group runs into jobs. A job is one process that trains seeds of one variant from the same step.

    The first jobs of all variants come first, so that every variant soon has a curve.

    Args:
        runs: unfinished runs.
        together: seeds per job, at most.
    """
    alike: defaultdict[tuple[str, int | None], list[PlannedRun]] = defaultdict(list)
    for run in runs:
        alike[run.variant, run.steps_saved].append(run)
    parts = [[same[i : i + together] for i in range(0, len(same), together)] for same in alike.values()]
    return [job for nth in itertools.zip_longest(*parts) for job in nth if job]


def most_together(runs: list[PlannedRun], num_slots: int) -> int:
    """The most seeds per job that still give every slot a job, if there are enough runs."""
    for together in range(max(map(len, jobs(runs, len(runs))), default=1), 1, -1):
        if len(jobs(runs, together)) >= min(num_slots, len(runs)):
            return together
    return 1


def start_job(
    job: list[PlannedRun], log: Path, device: int | None, share: int, lock: int, ends_with_parent: bool = False
) -> subprocess.Popen:
    """Start the process of a job. It resumes from the checkpoints, if there are some.

    Args:
        job: see `jobs`.
        log: file for the output of the process.
        device: the only GPU that the process sees; None changes nothing.
        share: jobs that share the GPU.
        lock: file descriptor that the process inherits.
        ends_with_parent: whether the process saves and ends when this one ends, even by SIGKILL.
    """
    first = job[0]
    is_resumed = first.steps_saved is not None
    for run in job:
        if not is_resumed and run.folder.is_run:
            with locked_folder(run.folder):
                shutil.rmtree(run.folder.path)  # it ended before its first checkpoint
    env = only_device(device) if device is not None else {}
    if ends_with_parent:
        env |= with_parent()
    if share > 1 and "XLA_PYTHON_CLIENT_MEM_FRACTION" not in os.environ:
        env["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{_MEMORY_FRACTION / share:.2f}"
    arguments = [*first.overrides, f"run_dir={first.folder.path.parent}", f"seeds={[run.config.seed for run in job]}"]
    if is_resumed:
        arguments.append("resume=true")
    log.parent.mkdir(parents=True, exist_ok=True)
    if log.is_file() and log.stat().st_nlink > 1:  # it is also another file, which must not grow
        log.unlink()
    with os.fdopen(open_to_append(log), "ab") as file:
        return start_module("train", *arguments, env=env, stdout=file, stderr=subprocess.STDOUT, pass_fds=(lock,))


def run_jobs(
    waiting: list[list[PlannedRun]],
    devices: list[int | None],
    logs: Path,
    on_end: Callable[[PlannedRun, Path], None],
    on_progress: Callable[[PlannedRun], None] = lambda _: None,
) -> str | None:
    """Run jobs until all have ended or a signal arrives, one at a time on each device.

    Args:
        waiting: see `jobs`.
        devices: GPUs, each repeated as often as jobs may share it; `[None]` for the CPU.
        logs: folder for the output of the jobs.
        on_end: called with each run that has ended, and the log of its job.
        on_progress: called now and then with each run that is being trained.

    Returns:
        Name of the signal that stopped it early, else None. All runs have then saved their state.
    """
    waiting, free = list(waiting), list(devices)
    running: dict[subprocess.Popen, tuple[list[PlannedRun], Path, int | None]] = {}
    share = len(devices) // len(set(devices))
    last_report = time.monotonic()
    with _lock(logs) as lock, Interrupt("the runs are saving") as interrupt:
        try:
            while (waiting or running) and not interrupt.signal_name:
                while waiting and free:
                    job, device = waiting.pop(0), free.pop(0)
                    log = logs / _log_name(job)
                    refuse_links(log, logs.parent)
                    check_replaceable(log)
                    running[start_job(job, log, device, share, lock)] = (job, log, device)
                time.sleep(0.5)
                for process in [process for process in running if process.poll() is not None]:
                    job, log, device = running.pop(process)
                    free.append(device)
                    for run in job:
                        on_end(run, log)
                if time.monotonic() - last_report > _SECONDS_BETWEEN_REPORTS:
                    last_report = time.monotonic()
                    for run in itertools.chain.from_iterable(job for job, _, _ in running.values()):
                        on_progress(run)
        finally:  # after an error, too, no job may outlive this process
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                process.wait()
        for job, log, _ in running.values():
            for run in job:
                on_end(run, log)
    return interrupt.signal_name


def _log_name(job: list[PlannedRun]) -> Path:
    first, last = job[0].config.seed, job[-1].config.seed
    return Path(job[0].variant, f"seed_{first}.txt" if len(job) == 1 else f"seeds_{first}_to_{last}.txt")


@contextlib.contextmanager
def _lock(folder: Path) -> Iterator[int]:
    """Lock a folder. The jobs inherit the file descriptor, so the lock holds until the last of them ends.

    Raises:
        UserError: another comparison holds the lock, or the folder cannot be written to.
    """
    refuse_links(folder, folder.parent)
    in_use = f"runs of {folder.parent} are still being trained; wait for them, or stop them"
    with contextlib.ExitStack() as held:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = held.enter_context(locked(folder / "lock", in_use))
        except OSError as error:
            raise UserError(f"cannot write to {folder}: {error.strerror}") from error
        yield lock
