"""Tables of the best recipe of each task, next to the published scores."""

import re
from typing import NamedTuple

from generator.fresh_seeds import shown_algorithm
from generator.markdown import code, table
from generator.score_tables import highest_published, number, read, results
from mjx_walk.experiments.suite import REFERENCES

ONE_SEED = {
    "EF4": ("at most 4 other runs", " total_steps=9000000"),
    "EG1": ("at most 8 other runs", " seed=1"),
    "EF6": ("at most 4 other runs", " total_steps=9000000"),
    "EB11": ("1 other run", ""),
    "ED5": ("1 other run", ""),
}
"""Arms of the recipes with one seed: other trainings on the GPU, and what follows the task and the algorithm."""
_DASH = "–"


class Best(NamedTuple):
    """The final policies of a task's best recipe for a GPU."""

    task: str
    algorithm: str
    score: str
    std_over_seeds: str
    std_over_episodes: str
    """Of a single seed."""
    seeds: str
    million_steps: str
    seconds: str
    """Training time, of all seeds of a process."""
    shared_with: str
    """Other trainings on the GPU at the same time."""
    command: str


def best_recipes() -> list[Best]:
    """For each task the recipe with the highest score.

    Recipes with several seeds count before those with one. At equal scores, the shorter training counts.
    """
    several: dict[str, list[Best]] = {}
    for row in results():
        if row["policy"] == "final":
            several.setdefault(row["task"], []).append(_of_several_seeds(row))
    one: dict[str, list[Best]] = {}
    for row in read("experiments.csv"):
        if row["id"] in ONE_SEED:
            one.setdefault(f"{row['task']}-{row['version']}", []).append(_of_one_seed(row))
    found = [several.get(task) or one[task] for task in REFERENCES]
    return [max(rows, key=lambda row: (float(row.score), -float(row.seconds))) for rows in found]


def _of_several_seeds(row: dict[str, str]) -> Best:
    others = int(row["seeds_per_process"]) - 1
    alone = row["alone_seconds"]
    return Best(
        task=row["task"],
        algorithm=row["algorithm"],
        score=row["score"],
        std_over_seeds=row["std"],
        std_over_episodes="",
        seeds=row["seeds"],
        million_steps=row["million_steps"],
        seconds=alone or row["seconds"],
        shared_with=_DASH if alone else f"{others} other seeds" + ", other runs" * row["time_of"].endswith("shared"),
        command=row["command"],
    )


def _of_one_seed(row: dict[str, str]) -> Best:
    shared_with, settings = ONE_SEED[row["id"]]
    algorithm = row["algorithm"]
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", row["task"]).lower()
    return Best(
        task=f"{row['task']}-{row['version']}",
        algorithm=shown_algorithm(algorithm),
        score=row["final_mean"],
        std_over_seeds="",
        std_over_episodes=row["std"],
        seeds="1",
        million_steps=f"{int(row['steps']) / 1e6:.1f}",
        seconds=row["seconds"],
        shared_with=shared_with,
        command=f"env={name} algo={algorithm}{settings}",
    )


def summary() -> str:
    """The table of README: scores and times."""
    rows = []
    for best in best_recipes():
        cells = [best.task, best.algorithm, number(best.score), number(best.std_over_seeds), best.seeds]
        rows.append([*cells, best.million_steps, f"{float(best.seconds) / 60:.1f}", code(best.command)])
    titles = ("Task", "Algorithm", ">Score", ">Std", ">Seeds", ">Steps (M)", ">Minutes", "Command")
    return table(titles, rows)


def detailed() -> str:
    """The same recipes with the spread of their scores and the load of the GPU."""
    rows = []
    for best in best_recipes():
        cells = [best.task, best.algorithm, number(best.score)]
        cells += [number(best.std_over_seeds), number(best.std_over_episodes), best.seeds, best.million_steps]
        rows.append([*cells, number(best.seconds), best.shared_with, code(best.command)])
    titles = ("Task", "Algorithm", ">Score", ">Std over seeds", ">Std over episodes", ">Seeds", ">Steps (M)")
    return table((*titles, ">Training (s)", "GPU shared with", "Command"), rows)


def comparison() -> str:
    """Scores and steps of the best recipes next to the highest published ones."""
    rows = []
    for best in best_recipes():
        cells = [best.task.removesuffix("-v5"), number(best.score), best.seeds, best.million_steps]
        for version, several_seeds in _OTHERS:
            row = highest_published(best.task.replace("v5", version), several_seeds)
            cells += [number(row["score"]), row["million_steps"]] if row else [_DASH, _DASH]
        rows.append(cells)
    titles = ("Task", ">Score (v5)", ">Seeds", ">Steps (M)", ">Highest mean (v5)", ">Steps (M)")
    titles += (">Highest single run (v5)", ">Steps (M)", ">Highest mean (v4)", ">Steps (M)")
    return table(titles, rows)


_OTHERS = (("v5", True), ("v5", False), ("v4", True))
"""Published scores to show: the version, and whether they are means over several seeds."""
