"""Tables of scores. The figures are in results.csv, published.csv, experiments.csv and the archive of fresh seeds."""

import csv
import re
from pathlib import Path

import numpy as np
import scipy.stats

from generator import fresh_seeds
from generator.markdown import code, table
from mjx_walk.experiments.suite import REFERENCES, normalize
from mjx_walk.utils.text import format_score

_DOCS = Path(__file__).parent.parent
_SUITE = re.compile(r"MS\d+")
"""Ids of the arms that trained all tasks; `@best` follows for the best policy."""


def highest_published(task: str, several_seeds: bool = True) -> dict[str, str] | None:
    """The row of published.csv with the highest score, or None.

    Args:
        task: with its version.
        several_seeds: whether to compare means over several seeds, or single runs.
    """
    rows = [row for row in read("published.csv") if row["task"] == task and (int(row["seeds"]) > 1) == several_seeds]
    return max(rows, key=lambda row: float(row["score"]), default=None)


def published(several_seeds: bool) -> str:
    """Published scores: means over several seeds, or single runs."""
    seeds = (">Seeds",) if several_seeds else ()
    titles = ("Task", "Algorithm", ">Score", ">Std", *seeds, ">Steps (M)", "Policy", "Date", "Source")
    rows = [
        (
            *(row["task"], row["algorithm"], number(row["score"]), number(row["std"])),
            *((row["seeds"],) if several_seeds else ()),
            *(row["million_steps"], row["policy"], row["date"], f"[{row['source']}]({row['link']})"),
        )
        for row in read("published.csv")
        if (int(row["seeds"]) > 1) == several_seeds
    ]
    return table(titles, rows)


def claims() -> str:
    """The numbers of README, with their sources."""
    titles = ("Claim of README", "Source", "Command", "What to know")
    rows = [(row["claim"].strip("| ").replace(" | ", ", "), *list(row.values())[1:]) for row in read("claims.csv")]
    return table(titles, rows)


def results() -> list[dict[str, str]]:
    """The scores of each recipe, those of fresh seeds included: the highest ones of a task first."""
    rows = [*read("results.csv"), *fresh_seeds.recipes()]
    return sorted(rows, key=lambda row: (list(REFERENCES).index(row["task"]), -float(row["score"])))


def recipes() -> str:
    """Every recipe for a GPU that has been scored."""
    titles = ("Task", "Algorithm", "Policy", ">Score", ">Std", ">Lowest seed", ">Seeds", ">Steps (M)")
    times = (">Seconds", ">Seeds per process", "Time of", ">One seed alone (s)")
    rows = [
        (
            *(row["task"], row["algorithm"], row["policy"]),
            *(number(row[key]) for key in ("score", "std", "lowest_seed")),
            *(row["seeds"], row["million_steps"], number(row["seconds"]), row["seeds_per_process"], row["time_of"]),
            number(row["alone_seconds"]),
            code(row["command"]),
        )
        for row in results()
    ]
    return table((*titles, *times, "Command"), rows)


def of_algorithm(name: str) -> str:
    """The recipes of one algorithm, with the cells that a reader compares."""
    rows = [
        (
            *(row["task"], row["algorithm"], row["policy"], number(row["score"]), number(row["std"]), row["seeds"]),
            *(row["million_steps"], code(row["command"])),
        )
        for row in results()
        if re.match(rf"{name}\b", row["algorithm"], flags=re.IGNORECASE)
    ]
    return table(("Task", "Algorithm", "Policy", ">Score", ">Std", ">Seeds", ">Steps (M)", "Command"), rows)


def suite() -> str:
    """One seed of csac on every task, and the normalized scores."""
    arms = {row["id"]: row for row in read("experiments.csv")}
    rows = []
    for name, final in arms.items():
        if _SUITE.fullmatch(name):
            chosen = arms[f"{name}@best"]
            task = f"{final['task']}-{final['version']}"
            scores = [number(row[key]) for row in (final, chosen) for key in ("final_mean", "std")]
            steps = [f"{int(row['steps']) / 1e6:.1f}" for row in (chosen, final)]
            rows.append(
                (task, *scores, *steps, number(final["seconds"]), *(number(str(score)) for score in REFERENCES[task]))
            )
    titles = (
        "Task",
        ">Final",
        ">Std",
        ">Best",
        ">Its std",
        ">Best policy's step (M)",
        ">Steps (M)",
        ">Seconds",
        ">Random actions",
        ">SLM-Lab",
    )
    heading = 'Scores over all tasks, with 0 for random actions and 1 for "SLM-Lab":'
    return f"{table(titles, rows)}\n\n{heading}\n\n{_normalized(arms)}"


def _normalized(arms: dict[str, dict[str, str]]) -> str:
    """The normalized scores over all tasks of the final and of the best policies."""
    lines = []
    for policies, suffix in (("final", ""), ("best", "@best")):
        rows = [row for name, row in arms.items() if _SUITE.fullmatch(name.removesuffix(suffix)) and suffix in name]
        scores = [normalize(f"{row['task']}-{row['version']}", float(row["final_mean"])) for row in rows]
        lines.append([policies, f"{np.mean(scores):.2f}", f"{scipy.stats.trim_mean(scores, 0.25):.2f}"])
    return table(("Policies", ">Mean", ">Interquartile mean"), lines)


def read(name: str) -> list[dict[str, str]]:
    """The rows of a file of figures, by column."""
    with (_DOCS / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def number(text: str) -> str:
    """A number as tables show it; a dash for a value that was not recorded."""
    if not text:
        return "–"
    return format_score(float(text)) if "." in text else f"{int(text):,}"
