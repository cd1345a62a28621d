"""`python -m mjx_walk.compare env=humanoid 'algos=[ppo,sac]' seeds=3`: algorithms and settings side by side."""

import dataclasses
import os
import sys
from pathlib import Path
from typing import Any

from mjx_walk.algos import ALGORITHMS
from mjx_walk.experiments import planned_runs
from mjx_walk.experiments.report import write_report
from mjx_walk.runs.config import Config
from mjx_walk.utils import cli
from mjx_walk.utils.devices import count_devices
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting
from mjx_walk.utils.signals import exit_code

USAGE = """
usage: python -m mjx_walk.compare [env=ENV] ['algos=[ppo,sac,td3]'] [seeds=3] [out=DIR] [KEY=VALUE ...]

  algos=[…]            algorithms, each with its recipe for the environment; all of them unless said otherwise
  seeds=N or [3,7]     the seeds 0 to N-1, or these
  KEY=VALUE            as for train, for all runs: env=walker2d total_steps=1_000_000
  KEY=A,B,C            a variant for each value: algo.learning_rate=1e-3,3e-4
  out=DIR              by default runs/compare_ENV; what is finished there is kept, what was interrupted goes on
  devices=N            GPUs to use; by default all
  per_device=N         processes that share a GPU
  together=N           seeds of a variant that are trained in one process; by default one on a CPU, and on GPUs as many
                       as leave each of them something to do
  draw=true            only draw what is below out=DIR, from wherever it came

It writes comparison.png, comparison.md and comparison.csv into out=DIR whenever a run ends.
"""


@dataclasses.dataclass
class Arguments:
    algos: tuple[str, ...] = setting(tuple(ALGORITHMS), choices=tuple(ALGORITHMS))
    seeds: Any = 3
    out: str | None = None
    devices: int | None = setting(None, at_least=1)
    per_device: int = setting(1, at_least=1)
    together: int | None = setting(None, at_least=1)
    draw: bool = False


def main(arguments: list[str]) -> int:
    """Run the cells that are not finished, and draw. Returns the exit code."""
    own, overrides = cli.parse_own(Arguments, Config, arguments, USAGE)
    if own.draw:
        if own.out is None:
            raise UserError("say which runs to draw: out=DIR")
        _report(Path(own.out))
        return 0
    if not own.algos:
        raise UserError(f"algos=[]: choose some of: {', '.join(ALGORITHMS)}")
    seeds = cli.read_seeds(own.seeds)
    hardware, available = count_devices()
    count = own.devices or available
    if count > available:
        raise UserError(f"devices={count}: this machine has {available}")
    out, planned = planned_runs.plan(overrides, list(own.algos), seeds, own.out, hardware)
    open_cells = [cell for cell in planned if not cell.is_finished]
    print(f"{len(planned)} runs, {len(planned) - len(open_cells)} of them finished before, in {out}", flush=True)

    def on_end(cell: planned_runs.Cell, log: Path) -> None:
        if not cell.is_finished:
            is_full = "RESOURCE_EXHAUSTED" in log.read_text(errors="replace")[-10_000:]
            hint = "; memory ran out, so try together=1 or a smaller num_envs" if is_full else ""
            print(f"{cell.name}: not finished; see {log}{hint}", flush=True)
            return
        print(f"{cell.name}: finished", flush=True)
        try:
            write_report(out)
        except (UserError, OSError, ValueError) as error:  # no reason to end the others
            print(f"warning: {out} could not be drawn: {error}", file=sys.stderr)

    slots: list[int | None] = list(range(count)) if hardware == "gpu" else [None]
    slots *= own.per_device
    # Measured with three seeds: 1.9 to 2.4 times as fast as in turn on an H200, 1.0 to 1.1 times on two cores.
    together = own.together or (planned_runs.most_together(open_cells, len(slots)) if hardware == "gpu" else 1)
    signal_name = planned_runs.run(planned_runs.jobs(open_cells, together), slots, out / "logs", on_end)
    if signal_name:
        print(f"Stopped by {signal_name}; the same command goes on.")
        return exit_code(signal_name)
    failed = [cell.name for cell in planned if not cell.is_finished]
    if failed:
        print(f"not finished: {', '.join(failed)}", file=sys.stderr)
    _report(out)
    return 1 if failed else 0


def _report(out: Path) -> None:
    report = write_report(out)
    print(report.read_text(), end="")
    print(f"{os.path.relpath(report)}, and .png and .csv beside it")


if __name__ == "__main__":
    cli.main(main)
