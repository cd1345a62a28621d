"""`python -m mjx_walk.compare env=humanoid 'algos=[ppo,sac]' seeds=3`: compare algorithms and settings over seeds.

`suite=mujoco` in place of `env=…` compares them on all environments.
"""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any

from mjx_walk.algos import ALGORITHMS
from mjx_walk.cli import parsing
from mjx_walk.experiments import planned_runs
from mjx_walk.experiments.job_logs import failure_reason
from mjx_walk.experiments.planned_runs import PlannedRun
from mjx_walk.experiments.report import write_report
from mjx_walk.experiments.slots import find_slots
from mjx_walk.experiments.suite import SUITES, plan_suite
from mjx_walk.machine.signals import exit_code
from mjx_walk.settings.config import Config
from mjx_walk.settings.overrides import key_of_value
from mjx_walk.storage.files import user_path
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.compare [env=ENV|suite=mujoco] ['algos=[ppo,sac,td3]'] [seeds=3] [out=DIR] [KEY=VALUE ...]

  suite=mujoco         all eleven environments, each with its own recipes; the report normalizes scores
  algos=[…]            algorithms, each with its recipe for the environment; by default all
  seeds=N or [3,7]     the seeds 0 to N-1, or the listed ones
  KEY=VALUE            as for train, for all runs: env=walker2d total_steps=1_000_000
  KEY=A,B,C            a variant per value: algo.learning_rate=1e-3,3e-4
  out=DIR              by default runs/compare_ENV or _SUITE; finished runs there are kept, and interrupted ones resume
  devices=N            GPUs to use; by default all
  per_device=N         processes that share a GPU
  together=N           seeds of a variant that one process trains; by default one on a CPU, and on GPUs as many as keep
                       every GPU busy
  draw=true            only draw the runs below out=DIR, whatever started them

It updates comparison.png, comparison.md and comparison.csv in out=DIR whenever a run ends.
"""


@dataclasses.dataclass
class Arguments:
    """Arguments that are not settings of the runs."""

    suite: str | None = setting(None, choices=tuple(SUITES))
    algos: tuple[str, ...] = setting(tuple(ALGORITHMS), choices=tuple(ALGORITHMS))
    seeds: Any = 3
    out: str | None = None
    devices: int | None = setting(None, at_least=1)
    per_device: int = setting(1, at_least=1)
    together: int | None = setting(None, at_least=1)
    draw: bool = False


def main(command_line: list[str]) -> int:
    """Train the runs that are not finished, and draw all. Returns the exit code."""
    arguments, overrides = parsing.parse_own(Arguments, Config, command_line, USAGE, key_of_value)
    if arguments.draw:
        if arguments.out is None:
            raise UserError("say which runs to draw: out=DIR")
        _print_report(user_path(arguments.out))
        return 0
    if not arguments.algos:
        raise UserError(f"algos=[]: choose some of: {', '.join(ALGORITHMS)}")
    if arguments.out is not None and user_path(arguments.out).is_file():
        raise UserError(f"out={arguments.out} is a file; give a folder")
    seeds = parsing.read_seeds(arguments.seeds)
    hardware, slots = find_slots(arguments.devices, arguments.per_device)
    options = (overrides, list(arguments.algos), seeds, arguments.out, hardware)
    out, planned = plan_suite(arguments.suite, *options) if arguments.suite else planned_runs.plan(*options)
    unfinished = [run for run in planned if not run.is_finished]
    print(f"{len(planned)} runs in {out}, {len(planned) - len(unfinished)} of them finished already", flush=True)
    # On an H200, five seeds of PPO train 1.6 times as fast together as in turn. On two cores, sharing gains nothing.
    default = planned_runs.most_together(unfinished, len(slots)) if hardware == "gpu" else 1
    jobs = planned_runs.jobs(unfinished, arguments.together or default)
    on_end = functools.partial(_on_end, out)
    signal_name = planned_runs.run_jobs(jobs, slots, out / "logs", on_end, _on_progress)
    if signal_name:
        print(f"Stopped by {signal_name}. Run the same command to resume.")
        return exit_code(signal_name)
    failed = [run.name for run in planned if not run.is_finished]
    if failed:
        print(f"not finished: {', '.join(failed)}", file=sys.stderr)
    _print_report(out)
    return 1 if failed else 0


def _on_progress(run: PlannedRun) -> None:
    print(f"  {run.name}: {run.progress}", flush=True)


def _on_end(out: Path, run: PlannedRun, log: Path) -> None:
    """Print how a run has ended, and update the report."""
    if not run.is_finished:
        reason = failure_reason(log, "so try together=1 or a smaller num_envs")
        print(f"{run.name}: not finished{': ' if reason else ''}{reason}; see {log}", flush=True)
        return
    print(f"{run.name}: finished", flush=True)
    try:
        write_report(out)
    except (UserError, OSError, ValueError) as error:  # the other runs continue
        print(f"warning: {out} could not be drawn: {error}", file=sys.stderr)


def _print_report(out: Path) -> None:
    report = write_report(out)
    print(report.read_text(encoding="utf-8"), end="")
    print(f"Written: {report}, and .png and .csv of the same name")


if __name__ == "__main__":
    parsing.main(main)
