"""Suites of environments, and the scores that normalize those of each environment."""

from pathlib import Path

from mjx_walk.envs import GYMNASIUM_TASKS
from mjx_walk.experiments import planned_runs
from mjx_walk.experiments.planned_runs import PlannedRun
from mjx_walk.storage.files import refuse_links, user_path
from mjx_walk.utils.errors import UserError

__all__ = ["REFERENCES", "SUITES", "normalize", "plan_suite"]

SUITES = {"mujoco": GYMNASIUM_TASKS}
"""Environments of each suite."""

REFERENCES = {
    "Humanoid-v5": (110, 3_774),
    "HumanoidStandup-v5": (33_501, 165_841),
    "Walker2d-v5": (1.93, 4_390),
    "Ant-v5": (-78.2, 4_943),
    "HalfCheetah-v5": (-281, 9_815),
    "Hopper-v5": (17.0, 1_972),
    "Swimmer-v5": (3.16, 301),
    "Reacher-v5": (-42.9, -5.03),
    "Pusher-v5": (-148, -37.1),
    "InvertedPendulum-v5": (5.63, 950),
    "InvertedDoublePendulum-v5": (50.1, 9_033),
}
"""For each environment, the score of uniformly random actions over 100 episodes, and the highest mean of four seeds
that SLM-Lab 5 has published for PPO, SAC and CrossQ on the same environment: an average of training returns.

Later reruns of SLM-Lab are lower. docs/published.csv has the source of each mean."""


def plan_suite(
    suite: str, overrides: list[str], algos: list[str], seeds: list[int], out: str | None, hardware: str
) -> tuple[Path, list[PlannedRun]]:
    """Plan the runs of a suite, as `planned_runs.plan` does for each environment, in a folder for each.

    Raises:
        UserError: an override of the environment, or any run has an invalid setting.
    """
    for override in overrides:
        if override.partition("=")[0] in ("env", "env.name"):
            raise UserError(f"'{override}': suite={suite} has its own environments; leave out one of the two")
    folder = user_path(out or f"runs/compare_{suite}")
    runs = []
    for env in SUITES[suite]:
        refuse_links(folder / env, folder)
        _, planned = planned_runs.plan([f"env={env}", *overrides], algos, seeds, str(folder / env), hardware)
        runs += [PlannedRun(f"{env}/{run.variant}", run.overrides, run.config) for run in planned]
    return folder, runs


def normalize(task: str, score: float) -> float:
    """0 for random actions, 1 for the reference."""
    random, reference = REFERENCES[task]
    return (score - random) / (reference - random)
