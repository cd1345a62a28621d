"""`python benchmarks/hills.py RUN …`: how policies of Gymnasium's tasks fare on hills."""

import argparse
import csv
import dataclasses
import sys

from mjx_walk.api import Run, deterministic_policy, load_run
from mjx_walk.envs.ground.options import PRESETS
from mjx_walk.evaluation.gymnasium_scores import compile_episodes, score_in_sim
from mjx_walk.evaluation.saved_policies import make_task

__all__ = ["mean_return"]

_DESCRIPTION = """
Score the best policies of runs on each preset of env.ground, with the reward of the flat floor. Print CSV, a row for
each. RUN is a run folder or zoo:NAME.
"""


def main() -> None:
    parser = argparse.ArgumentParser("python benchmarks/hills.py", description=_DESCRIPTION)
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--episodes", type=int, default=20)
    given = parser.parse_args()
    rows = csv.writer(sys.stdout)
    rows.writerow(("Run", *PRESETS))
    for name in given.runs:
        run = load_run(name, physics="c")
        rows.writerow((name, *(f"{mean_return(run, kind, given.episodes):.1f}" for kind in PRESETS)))
        sys.stdout.flush()


def mean_return(run: Run, kind: str, episodes: int) -> float:
    """The mean return of a run's policy on hills of one kind, on the `c` engine."""
    env = dataclasses.replace(run.config.env, ground=PRESETS[kind])
    task = make_task(dataclasses.replace(run.config, env=env, physics="c"))
    played = compile_episodes(task, deterministic_policy(run.algorithm, run.policy_params))
    return float(score_in_sim(task, played, episodes).returns.mean())


if __name__ == "__main__":
    main()
