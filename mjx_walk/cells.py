"""The cells of a comparison: each variant with each seed is a training run in a folder and process of its own."""

import dataclasses
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser

from mjx_walk.config import Config, complete_overrides, flatten, load_config, read_config
from mjx_walk.errors import UserError
from mjx_walk.interrupt import Interrupt
from mjx_walk.metrics import read_rows
from mjx_walk.run_folder import MAY_DIFFER, RunFolder

_SECONDS_BETWEEN_REPORTS = 30.0


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of a comparison."""

    variant: str
    """What sets it apart from the others, as a folder name: `ppo`, `ppo_learning_rate-0.001`."""
    overrides: tuple[str, ...]
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
    def is_finished(self) -> bool:
        """Trained to the end, and scored if it is to be."""
        if not self.folder.config.exists() or self.steps_done < self.config.total_steps:
            return False
        if not self.config.evaluation.gymnasium_episodes:
            return True
        scores = self.folder.gymnasium_scores
        return scores.exists() and len(json.loads(scores.read_text())["returns"]) > 0


def plan(overrides: list[str], algos: list[str], seeds: list[int], out: Path, hardware: str) -> list[Cell]:
    """All cells, seeds outermost, so that every variant has a first curve early.

    Args:
        overrides: as for `train`; a comma makes variants, `algo.learning_rate=1e-3,3e-4`.
        algos: algorithms.
        seeds: seeds.
        out: folder of the comparison.
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
        if override.is_sweep_override():
            values = override.sweep_string_iterator()
            choices.append([f"{override.key_or_group}={value}" for value in values])
        else:
            choices.append([str(override.input_line)])
    cells: dict[str, Cell] = {}
    for seed, chosen in itertools.product(seeds, itertools.product(*choices)):
        swept = [text for text, options in zip(chosen[1:], choices[1:], strict=True) if len(options) > 1]
        # No "=" and no ",", which would mean something to Hydra where the folder is named to it again.
        parts = [re.sub(r"[^\w.+]+", "-", text.removeprefix("algo").lstrip("=.")) for text in (chosen[0], *swept)]
        variant = "_".join(parts)
        run_dir = out / variant / f"seed_{seed}"
        quoted = str(run_dir).replace("\\", "\\\\").replace("'", "\\'")
        arguments = (*chosen, f"seed={seed}", f"run_dir='{quoted}'")
        cell = Cell(variant, arguments, load_config(list(arguments)))
        if cells.setdefault(cell.name, cell).config != cell.config:
            raise UserError(f"two variants would share the folder {run_dir}; compare them in two comparisons")
    for cell in cells.values():
        _check_same_configuration(cell)
    return list(cells.values())


def start(cell: Cell, log: Path, device: int | None) -> subprocess.Popen:
    """Train a cell, from where it was left, in a process of its own.

    Args:
        cell: not finished.
        log: file for what it prints.
        device: the GPU that it is to see; None leaves that as it is.
    """
    resume = bool(list(cell.folder.checkpoints.glob("[0-9]*")))
    if not resume and cell.folder.config.exists():
        shutil.rmtree(cell.folder.path)  # it was ended before it had saved anything
    env = dict(os.environ)
    if device is not None:
        visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
        env["CUDA_VISIBLE_DEVICES"] = visible[device] if visible else str(device)
    log.parent.mkdir(parents=True, exist_ok=True)
    arguments = [sys.executable, "-m", "mjx_walk.train", *cell.overrides, *(["resume=true"] if resume else [])]
    with log.open("a") as file:
        # A session of its own: Ctrl-C is for the parent, which passes it on once.
        return subprocess.Popen(arguments, stdout=file, stderr=subprocess.STDOUT, env=env, start_new_session=True)


def run(cells: list[Cell], devices: list[int | None], logs: Path, on_end: Callable[[Cell], None]) -> str | None:
    """Train all cells, one at a time on each device, and say how they are getting on.

    Args:
        cells: not finished.
        devices: GPUs, each as often as it is to be shared; `[None]` for the CPU.
        logs: folder for what the cells print.
        on_end: called with every cell that has ended.

    Returns:
        The name of the signal that stopped it early, if one did; all cells have then saved.
    """
    waiting, running, free = list(cells), dict[subprocess.Popen, tuple[Cell, int | None]](), list(devices)
    last_report = time.monotonic()
    with Interrupt("the runs are saving") as interrupt:
        while (waiting or running) and not interrupt.signal_name:
            while waiting and free:
                cell, device = waiting.pop(0), free.pop(0)
                running[start(cell, logs / f"{cell.name}.txt", device)] = (cell, device)
            time.sleep(0.5)
            for process in [process for process in running if process.poll() is not None]:
                cell, device = running.pop(process)
                free.append(device)
                on_end(cell)
            if time.monotonic() - last_report > _SECONDS_BETWEEN_REPORTS:
                last_report = time.monotonic()
                for cell, _ in running.values():
                    print(f"  {cell.name}: {_progress(cell)}", flush=True)
        for process in running:
            process.send_signal(signal.SIGTERM)
        for process, (cell, _) in running.items():
            process.wait()
            on_end(cell)
    return interrupt.signal_name


def _progress(cell: Cell) -> str:
    rows = read_rows(cell.folder.metrics)
    if not rows:
        return "starting"
    last = {name: value for row in rows for name, value in row.items() if value is not None}
    text = f"{rows[-1]['env_steps'] / 1e6:.2f} of {cell.config.total_steps / 1e6:.2f} million steps"
    return text + (f", return {last['episode/return']:,.0f}" if "episode/return" in last else "")


def count_devices() -> tuple[str, int]:
    """`gpu` or `cpu`, and how many; asked in another process, since JAX would claim the memory of all of them."""
    code = "import jax; print(jax.default_backend() != 'cpu', jax.local_device_count())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    is_gpu, count = done.stdout.split()[-2:]
    return ("gpu", int(count)) if is_gpu == "True" else ("cpu", 1)


def _check_same_configuration(cell: Cell) -> None:
    if not cell.folder.config.exists():
        return
    old, new = flatten(read_config(cell.folder.config)), flatten(cell.config)
    # The engine may have been chosen by itself.
    differing = [key for key in new if key not in (*MAY_DIFFER, "physics") and old.get(key) != new[key]]
    if differing:
        raise UserError(
            f"{cell.folder.path} holds a run with other settings ({', '.join(differing)}); choose another out=DIR"
        )
