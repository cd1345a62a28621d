"""`python -m mjx_walk.tune env=walker2d algo=sac trials=50`: search for better settings with Optuna."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

from mjx_walk.cli import parsing
from mjx_walk.experiments.planned_runs import PlannedRun
from mjx_walk.experiments.search_space import read_space
from mjx_walk.experiments.study import StudyFolder, facts_of, require_optuna
from mjx_walk.experiments.suggestions import PRUNERS, SAMPLERS
from mjx_walk.experiments.trials import Tuning, refuse_changed_files, run_trials
from mjx_walk.experiments.tuning_report import ranked, summary, write_page, write_tables
from mjx_walk.machine.devices import count_devices
from mjx_walk.machine.nvidia import warn_of_unused_gpu
from mjx_walk.machine.signals import exit_code
from mjx_walk.settings.config import Config, flatten
from mjx_walk.settings.overrides import key_of_value
from mjx_walk.storage.files import user_path
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import MAX_SEED, setting
from mjx_walk.utils.text import format_score

if TYPE_CHECKING:
    import optuna

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.tune [env=ENV] [algo=ALGO] [trials=50] [out=DIR] [KEY=VALUE ...]

  KEY=VALUE                            as for train, for all trials: total_steps=1_000_000
  KEY=A,B,C                            search these values: algo.discount=0.97,0.99
  'KEY=interval(A,B)'                  search the numbers from A to B
  'KEY=tag(log,interval(A,B))'         the same on a logarithmic scale; by default the ranges of docs/tuning.md
  default_ranges=true                  search these ranges besides the given ones
  trials=N                             trials of the complete study
  seeds=N or [3,7]                     training seeds of each trial, by default [0]; the value is their mean
  sampler=tpe|random   seed=N          how values are chosen
  pruner=median|halving|hyperband|none which trials end early
  out=DIR                              by default runs/tune_ENV_ALGO
  devices=N   per_device=N             GPUs to use, by default all, and trials that share a GPU
  draw=true                            only write the report of the study in out=DIR

The first trial has the recipe's own values. The value of a trial is the mean return of the last three evaluations
during training. The same command continues a study; a second one at the same time works on the same study. The report
is report.html in out=DIR, and the best trial is the recipe best.yaml. It needs Optuna: pip install 'mjx-walk[tune]'
"""


@dataclasses.dataclass
class Arguments:
    """Arguments that are not settings of the runs."""

    trials: int = setting(50, at_least=1)
    seeds: Any = 1
    sampler: str = setting("tpe", choices=SAMPLERS)
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)
    pruner: str = setting("median", choices=PRUNERS)
    default_ranges: bool = False
    out: str | None = None
    devices: int | None = setting(None, at_least=1)
    per_device: int = setting(1, at_least=1)
    draw: bool = False


def main(command_line: list[str]) -> int:
    """Run the trials that are missing, and write the report. Returns the exit code."""
    arguments, overrides = parsing.parse_own(Arguments, Config, command_line, USAGE, key_of_value)
    if arguments.out is not None and user_path(arguments.out).is_file():
        raise UserError(f"out={arguments.out} is a file; give a folder")
    if "${" in (arguments.out or ""):
        raise UserError(f"out={arguments.out}: '${{' names another setting; choose a name without it")
    if arguments.draw:
        if arguments.out is None:
            raise UserError("say which study to draw: out=DIR")
        others = [word for word in command_line if word.partition("=")[0] not in ("draw", "out")]
        if others:
            raise UserError(f"'{others[0]}' has no effect with draw=true; leave it out")
        require_optuna()
        return _write_report(StudyFolder(user_path(arguments.out)))
    seeds = parsing.read_seeds(arguments.seeds)
    hardware, available = count_devices()
    if hardware == "cpu":
        warn_of_unused_gpu()
    count = arguments.devices or available
    if count > available:
        raise UserError(f"devices={count}: this machine has {available}; leave it out to use all")
    space = read_space(overrides, hardware, arguments.default_ranges)
    require_optuna()
    env, algo = space.recipe.env.name, space.recipe.algo.name
    folder = StudyFolder(user_path(arguments.out or f"runs/tune_{env}_{algo}"))
    if "," in str(folder.path):  # compare takes several recipes with commas between them
        raise UserError(f"out={folder.path}: choose a name without a comma")
    study = folder.create_or_open(facts_of(space, seeds))
    ended = sum(trial.state.is_finished() for trial in study.get_trials(deepcopy=False))
    print(f"A study of {arguments.trials} trials in {folder.path}, of which {ended} ended before", flush=True)
    for key, values in space.ranges.items():
        outside = "" if key in space.recipe_values else f"; the recipe's own lies outside: {flatten(space.recipe)[key]}"
        print(f"  {key}={values}{outside}", flush=True)
    refuse_changed_files(folder, space, seeds)
    tuning = Tuning(folder, space, seeds, arguments.trials, arguments.sampler, arguments.pruner, arguments.seed)
    slots: list[int | None] = list(range(count)) if hardware == "gpu" else [None]
    on_end = functools.partial(_on_end, folder, study)
    signal_name = run_trials(tuning, study, slots * arguments.per_device, on_end, _on_progress)
    if signal_name:
        print(f"Stopped by {signal_name}. Run the same command to continue.")
        return exit_code(signal_name)
    return _write_report(folder)


def _on_progress(run: PlannedRun) -> None:
    print(f"  {run.name}: {run.progress}", flush=True)


def _on_end(folder: StudyFolder, study: "optuna.Study", number: int) -> None:
    """Print how a trial has ended, and update the files that are quick to write."""
    trial, best = study.get_trials(deepcopy=False)[number], ranked(study)
    values = " ".join(f"{key}={value}" for key, value in trial.params.items())
    leader = f", best {format_score(best[0].value)} by trial {best[0].number}" if best else ""
    reason = trial.user_attrs.get("reason")
    result = f"failed: {reason}" if reason else f"{trial.state.name.lower()}, {format_score(trial.value)}{leader}"
    print(f"trial {number}: {result}{values and f'; {values}'}", flush=True)
    write_tables(folder, study)


def _write_report(folder: StudyFolder) -> int:
    """Write all files about a study. Returns the exit code: 1 if no trial is complete."""
    study = folder.open()
    write_tables(folder, study)
    page = write_page(folder, study)
    print(summary(folder, study))
    print(f"Written: {page}, trials.csv{', and the best trials as recipes' if ranked(study) else ''}")
    return 0 if ranked(study) else 1


if __name__ == "__main__":
    parsing.main(main)
