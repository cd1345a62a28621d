"""The cells of a comparison: each variant with each seed is a training run in a folder of its own."""

import contextlib
import dataclasses
import fcntl
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser

from mjx_walk.envs.physics import resolve_engine
from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import Config, complete_overrides, load_config, read_config
from mjx_walk.runs.metrics import read_rows
from mjx_walk.runs.run_folder import RunFolder, differences
from mjx_walk.utils.devices import only_device
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.signals import Interrupt

_SECONDS_BETWEEN_REPORTS = 30.0
_MEMORY_FRACTION = 0.75
"""Of a GPU's memory that JAX takes at the start; its own default."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of a comparison."""

    variant: str
    """What sets it apart from the others, as a folder name: `ppo`, `ppo_learning_rate-0.001`."""
    overrides: tuple[str, ...]
    """All but its seed and its folder."""
    config: Config

    @property
    def folder(self) -> RunFolder:
        return RunFolder(Path(str(self.config.run_dir)))

    @property
    def name(self) -> str:
        return f"{self.variant}/seed_{self.config.seed}"

    @property
    def steps_done(self) -> int:
        """Environment steps logged so far."""
        rows = read_rows(self.folder.metrics)
        return int(rows[-1]["env_steps"]) if rows else 0

    @property
    def steps_saved(self) -> int | None:
        """Environment steps behind its newest checkpoint, if it has one."""
        saved = checkpoint.list_steps(self.folder.checkpoints)
        return int(saved[-1].name) if saved else None

    @property
    def is_finished(self) -> bool:
        """Trained to the end, and scored if it is to be."""
        if not self.folder.config.exists() or self.steps_done < self.config.total_steps:
            return False
        if not self.config.evaluation.gymnasium_episodes:
            return True
        return self.folder.gymnasium_scores.exists()


def plan(
    overrides: list[str], algos: list[str], seeds: list[int], out: str | None, hardware: str
) -> tuple[Path, list[Cell]]:
    """Folder and cells of a comparison.

    Args:
        overrides: as for `train`; a comma makes variants, `algo.learning_rate=1e-3,3e-4`.
        algos: algorithms.
        seeds: seeds.
        out: folder of the comparison; by default `runs/compare_ENV`.
        hardware: `gpu` or `cpu`, the size of the recipes.

    Raises:
        UserError: anything wrong in any cell, before one is begun.
    """
    own = {"algo": "algos=[…]", "seed": "seeds=N", "run_dir": "out=DIR", "resume": "nothing: it always resumes"}
    choices: list[list[str]] = [[f"algo={algo}" for algo in algos]]
    parsed = OverridesParser.create().parse_overrides(complete_overrides([f"hardware={hardware}", *overrides]))
    for override in parsed:
        if override.key_or_group in own:
            raise UserError(f"'{override.input_line}': in a comparison write {own[override.key_or_group]}")
        if not override.is_sweep_override():
            choices.append([str(override.input_line)])
        elif override.is_choice_sweep():
            values = override.sweep_string_iterator()
            choices.append([f"{override.key_or_group}={value}" for value in values])
        else:
            raise UserError(f"'{override.input_line}': list the values, {override.key_or_group}=A,B")
    first = load_config([options[0] for options in choices])
    folder = Path(out or f"runs/compare_{first.env.name}")
    cells: dict[str, Cell] = {}
    for seed, chosen in itertools.product(seeds, itertools.product(*choices)):
        swept = [text for text, options in zip(chosen[1:], choices[1:], strict=True) if len(options) > 1]
        # No "=" and no ",", which would mean something to Hydra where the folder is named to it again.
        parts = (text.removeprefix("algo").lstrip("=.").replace("=", "-") for text in (chosen[0], *swept))
        variant = "_".join(re.sub(r"[^\w.+-]+", "_", part) for part in parts)
        run_dir = folder / variant / f"seed_{seed}"
        config = dataclasses.replace(load_config(list(chosen)), seed=seed, run_dir=str(run_dir))
        cell = Cell(variant, chosen, config)
        if cells.setdefault(cell.name, cell).config != cell.config:
            raise UserError(f"two variants would share the folder {run_dir}; compare them in two comparisons")
    environments = {f"{cell.config.env.name} {cell.config.env.version}" for cell in cells.values()}
    if len(environments) > 1:
        raise UserError(f"one comparison is of one environment, not of {', '.join(sorted(environments))}")
    for cell in cells.values():
        _check_same_configuration(cell)
    return folder, list(cells.values())


def jobs(cells: list[Cell], together: int) -> list[list[Cell]]:
    """What is trained in one process each: seeds of one variant that stand at the same step. First ones first, so that
    every variant has a curve early.

    Args:
        cells: not finished.
        together: seeds of a process, at most.
    """
    alike: dict[tuple[str, int | None], list[Cell]] = {}
    for cell in cells:
        alike.setdefault((cell.variant, cell.steps_saved), []).append(cell)
    parts = [[same[i : i + together] for i in range(0, len(same), together)] for same in alike.values()]
    return [job for nth in itertools.zip_longest(*parts) for job in nth if job]


def most_together(cells: list[Cell], num_slots: int) -> int:
    """How many seeds a process may have for as many processes as there are places, if there are so many cells."""
    for together in range(max(map(len, jobs(cells, len(cells))), default=1), 1, -1):
        if len(jobs(cells, together)) >= min(num_slots, len(cells)):
            return together
    return 1


def start(job: list[Cell], log: Path, device: int | None, share: int, lock: int) -> subprocess.Popen:
    """Train the cells of a job, from where they were left, in a process of its own.

    Args:
        job: see `jobs`.
        log: file for what it prints.
        device: the GPU that it is to see; None leaves that as it is.
        share: jobs that share the GPU.
        lock: a file descriptor to inherit.
    """
    first = job[0]
    is_resumed = first.steps_saved is not None
    for cell in job:
        if not is_resumed and cell.folder.config.exists():
            shutil.rmtree(cell.folder.path)  # it was ended before it had saved anything
    env = dict(os.environ)
    if device is not None:
        env |= only_device(device)
    if share > 1:
        env.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{_MEMORY_FRACTION / share:.2f}")
    log.parent.mkdir(parents=True, exist_ok=True)
    quoted = str(first.folder.path.parent).replace("\\", "\\\\").replace("'", "\\'")
    where = [f"run_dir='{quoted}'", f"seeds={[cell.config.seed for cell in job]}"]
    arguments = [sys.executable, "-m", "mjx_walk.train", *first.overrides, *where]
    with log.open("a") as file:
        # A session of its own: Ctrl-C is for the parent, which passes it on once.
        pipes = {"stdout": file, "stderr": subprocess.STDOUT, "pass_fds": (lock,)}
        arguments += ["resume=true"] if is_resumed else []
        return subprocess.Popen(arguments, env=env, start_new_session=True, **pipes)  # type: ignore[call-overload]


def run(
    waiting: list[list[Cell]], devices: list[int | None], logs: Path, on_end: Callable[[Cell, Path], None]
) -> str | None:
    """Work through jobs, one at a time on each device, and say how they are getting on.

    Args:
        waiting: see `jobs`.
        devices: GPUs, each as often as it is to be shared; `[None]` for the CPU.
        logs: folder for what the jobs print.
        on_end: called with every cell that has ended, and the log of its job.

    Returns:
        The name of the signal that stopped it early, if one did; all cells have then saved.
    """
    waiting, free = list(waiting), list(devices)
    running: dict[subprocess.Popen, tuple[list[Cell], int | None]] = {}
    share = len(devices) // len(set(devices))
    last_report = time.monotonic()

    def log_of(job: list[Cell]) -> Path:
        first, last = job[0].config.seed, job[-1].config.seed
        return logs / job[0].variant / (f"seed_{first}.txt" if len(job) == 1 else f"seeds_{first}_to_{last}.txt")

    def end(job: list[Cell]) -> None:
        for cell in job:
            on_end(cell, log_of(job))

    with _only_one_at_a_time(logs) as lock, Interrupt("the runs are saving") as interrupt:
        try:
            while (waiting or running) and not interrupt.signal_name:
                while waiting and free:
                    job, device = waiting.pop(0), free.pop(0)
                    running[start(job, log_of(job), device, share, lock)] = (job, device)
                time.sleep(0.5)
                for process in [process for process in running if process.poll() is not None]:
                    job, device = running.pop(process)
                    free.append(device)
                    end(job)
                if time.monotonic() - last_report > _SECONDS_BETWEEN_REPORTS:
                    last_report = time.monotonic()
                    for job, _ in running.values():
                        for cell in job:
                            print(f"  {cell.name}: {_progress(cell)}", flush=True)
        finally:  # however it ends, no run goes on alone
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                process.wait()
        for job, _ in running.values():
            end(job)
    return interrupt.signal_name


@contextlib.contextmanager
def _only_one_at_a_time(folder: Path) -> Iterator[int]:
    """A lock that the runs inherit, so that it is held as long as one of them lives."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / "lock").open("w")
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(f"runs of {folder.parent} are still going on; wait for them, or end them") from error
        yield file.fileno()


def _progress(cell: Cell) -> str:
    rows = read_rows(cell.folder.metrics)
    if not rows:
        return "starting"
    last = {name: value for row in rows for name, value in row.items() if value is not None}
    text = f"{rows[-1]['env_steps'] / 1e6:.2f} of {cell.config.total_steps / 1e6:.2f} million steps"
    return text + (f", return {last['episode/return']:,.0f}" if "episode/return" in last else "")


def _check_same_configuration(cell: Cell) -> None:
    if not cell.folder.config.exists():
        return
    saved = read_config(cell.folder.config)
    differing = differences(saved, dataclasses.replace(cell.config, physics=resolve_engine(cell.config.physics)))
    if cell.config.total_steps < saved.total_steps:
        differing.append("total_steps, which may only grow")
    if differing:
        raise UserError(
            f"{cell.folder.path} holds a run with other settings ({', '.join(differing)}); choose another out=DIR"
        )
