"""Speed on several GPUs: the arms in experiments.csv, their tables, and their factors for the figure."""

from typing import NamedTuple

from generator.markdown import table
from generator.score_tables import read


class Arm(NamedTuple):
    """One training of Humanoid-v5 on GPUs of one host."""

    algorithm: str
    gpus: int
    num_envs: int
    """Environments on each GPU."""
    id: str
    """Its row in experiments.csv."""
    alone: str
    """The arm on one GPU, of the same version, that its factor is relative to."""
    version: str
    """Date of the code."""


_EARLIER, _LATER = "27 November 2026", "28 November 2026"
ARMS = (
    Arm("PPO", 1, 16_384, "SP62", "SP62", _LATER),
    Arm("PPO", 2, 16_384, "SP63", "SP62", _LATER),
    Arm("PPO", 1, 16_384, "SP47", "SP47", _EARLIER),
    Arm("PPO", 4, 16_384, "SP49", "SP47", _EARLIER),
    Arm("PPO", 2, 8_192, "SP50", "SP47", _EARLIER),
    Arm("PPO", 4, 4_096, "SP51", "SP47", _EARLIER),
    Arm("csac", 1, 2_048, "SP60", "SP60", _LATER),
    Arm("csac", 2, 2_048, "SP61", "SP60", _LATER),
    Arm("csac", 1, 2_048, "SP52", "SP52", _EARLIER),
    Arm("csac", 4, 2_048, "SP54", "SP52", _EARLIER),
    Arm("csac", 2, 1_024, "SP55", "SP52", _EARLIER),
    Arm("csac", 4, 512, "SP56", "SP52", _EARLIER),
)
ON_ONE_GPU = {"PPO": 16_384, "csac": 2_048}
"""Environments of each recipe on one GPU."""
_STEPS_PER_CALL = {"PPO": 80, "csac": 50}
"""Steps of each environment in a call."""


def factors(algorithm: str, same_total: bool) -> dict[int, float]:
    """Speed relative to one GPU, by the number of GPUs.

    Args:
        algorithm: `PPO` or `csac`.
        same_total: whether all GPUs together have the environments of one, instead of as many on each.
    """
    speeds = _speeds()
    arms = [arm for arm in ARMS if arm.algorithm == algorithm and arm.gpus > 1]
    return {
        arm.gpus: speeds[arm.id] / speeds[arm.alone]
        for arm in arms
        if (arm.num_envs < ON_ONE_GPU[algorithm]) == same_total
    }


def detailed() -> str:
    """A row for each arm."""
    speeds, rows = _speeds(), []
    for arm in ARMS:
        factor = [f"{speeds[arm.id] / speeds[arm.alone]:.2f}", arm.gpus] if arm.gpus > 1 else ["–", "–"]
        call = 1e3 * _STEPS_PER_CALL[arm.algorithm] * arm.gpus * arm.num_envs / speeds[arm.id]
        cells = [arm.algorithm, arm.version, arm.gpus, f"{arm.num_envs:,}", f"{speeds[arm.id]:,.0f}"]
        rows.append([*cells, *factor, f"{call:,.0f}"])
    titles = ("Algorithm", "Version", ">GPUs", ">Environments on each", ">Steps/s", ">Factor", ">Ideal", ">Call (ms)")
    return table(titles, rows)


def summary() -> str:
    """The factors alone."""
    rows = []
    for algorithm in ON_ONE_GPU:
        each, total = factors(algorithm, same_total=False), factors(algorithm, same_total=True)
        rows += [[algorithm, gpus, f"{each[gpus]:.2f}", f"{total[gpus]:.2f}"] for gpus in each]
    return table(("Recipe", ">GPUs", ">Same number of environments per GPU", ">Same total number"), rows)


def _speeds() -> dict[str, float]:
    """Steps per second of every arm."""
    return {row["id"]: float(row["final_mean"]) for row in read("experiments.csv") if row["measure"] == "speed"}
