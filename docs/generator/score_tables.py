"""Tables of scores. The figures are in results.csv, experiments.csv and the zoo."""

import csv
import re
from pathlib import Path

from generator.markdown import code, table
from mjx_walk.experiments.suite import REFERENCES
from mjx_walk.utils.text import format_score

_DOCS = Path(__file__).parent.parent
_SUITE = re.compile(r"MS\d+")
"""Ids of the arms that trained all tasks; `@best` follows for the best policy."""


def best() -> str:
    """For each task the algorithm with the highest score, next to what others have published."""
    titles = ("Task", "Algorithm", ">Score", ">Std", ">Seeds", ">Steps (M)", ">Minutes")
    published = (">Highest published (v5)", ">Highest published (v4)")
    rows = [
        (
            *(row["task"], row["algorithm"], _number(row["score"]), _number(row["std"]), row["seeds"]),
            *(row["million_steps"], f"{float(row['seconds']) / 60:.1f}"),
            *(_number(row["published_v5"]), _number(row["published_v4"])),
            code(row["command"]),
        )
        for row in read("results.csv")
        if row["published_v5"]
    ]
    return table((*titles, *published, "Command"), rows)


def recipes() -> str:
    """Every recipe for a GPU that has been scored."""
    titles = ("Task", "Algorithm", "Policy", ">Score", ">Std", ">Lowest seed", ">Seeds", ">Steps (M)")
    times = (">Seconds", ">Seeds per process", "Time of")
    rows = [
        (
            *(row["task"], row["algorithm"], row["policy"]),
            *(_number(row[key]) for key in ("score", "std", "lowest_seed")),
            *(row["seeds"], row["million_steps"], _number(row["seconds"]), row["seeds_per_process"], row["time_of"]),
            code(row["command"]),
        )
        for row in read("results.csv")
    ]
    return table((*titles, *times, "Command"), rows)


def of_algorithm(name: str) -> str:
    """The recipes of one algorithm, with the cells that a reader compares."""
    rows = [
        (
            *(row["task"], row["algorithm"], row["policy"], _number(row["score"]), _number(row["std"]), row["seeds"]),
            *(row["million_steps"], code(row["command"])),
        )
        for row in read("results.csv")
        if re.match(rf"{name}\b", row["algorithm"], flags=re.IGNORECASE)
    ]
    return table(("Task", "Algorithm", "Policy", ">Score", ">Std", ">Seeds", ">Steps (M)", "Command"), rows)


def suite() -> str:
    """One seed of csac on every task."""
    arms = {row["id"]: row for row in read("experiments.csv")}
    rows = []
    for name, final in arms.items():
        if _SUITE.fullmatch(name):
            chosen = arms[f"{name}@best"]
            task = f"{final['task']}-{final['version']}"
            scores = [_number(row[key]) for row in (final, chosen) for key in ("final_mean", "std")]
            steps = [f"{int(row['steps']) / 1e6:.1f}" for row in (chosen, final)]
            rows.append((task, *scores, *steps, _number(final["seconds"]), _number(str(REFERENCES[task][1]))))
    titles = (
        "Task",
        ">Final",
        ">Std",
        ">Best",
        ">Its std",
        ">Best policy's step (M)",
        ">Steps (M)",
        ">Seconds",
        ">Published",
    )
    return table(titles, rows)


def read(name: str) -> list[dict[str, str]]:
    """The rows of a file of figures, by column."""
    with (_DOCS / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _number(text: str) -> str:
    """A number as tables show it; a dash for a value that was not recorded."""
    if not text:
        return "–"
    return format_score(float(text)) if "." in text else f"{int(text):,}"
