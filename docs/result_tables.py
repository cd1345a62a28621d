"""`python docs/result_tables.py`: write the tables of scores into README.md and results.md.

The figures are in results.csv, experiments.csv and the zoo. A table stands between `<!-- begin NAME -->` and
`<!-- end NAME -->`.
"""

import csv
import re
from pathlib import Path

from mjx_walk import zoo
from mjx_walk.experiments.suite import REFERENCES
from mjx_walk.utils.text import format_score

DOCS = Path(__file__).parent
PAGES = (DOCS.parent / "README.md", DOCS / "results.md")
_SUITE = re.compile(r"MS\d+")
"""Ids of the arms that trained all tasks; `@best` follows for the best policy."""


def best() -> str:
    """For each task the algorithm with the highest score, next to what others have published."""
    header = (
        "Task | Algorithm | Score | Std | Seeds | Minutes | Highest published (v5) | Highest published (v4) | Command"
    )
    return _table(
        header,
        [
            (
                *(row["task"], row["algorithm"], _number(row["score"]), _number(row["std"]), row["seeds"]),
                *(f"{float(row['seconds']) / 60:.1f}", _number(row["published_v5"]), _number(row["published_v4"])),
                f"`{row['command']}`",
            )
            for row in _read("results.csv")
            if row["published_v5"]
        ],
        numbers=range(2, 8),
    )


def recipes() -> str:
    """Every recipe for a GPU that has been scored."""
    times = "Steps (M) | Seconds | Seeds per process | Time of"
    header = f"Task | Algorithm | Score | Std | Lowest seed | Seeds | {times} | Command"
    return _table(
        header,
        [
            (
                *(row["task"], row["algorithm"], *(_number(row[key]) for key in ("score", "std", "lowest_seed"))),
                *(row["seeds"], row["million_steps"], row["seconds"], row["seeds_per_process"], row["time_of"]),
                f"`{row['command']}`",
            )
            for row in _read("results.csv")
        ],
        numbers=range(2, 9),
    )


def suite() -> str:
    """One seed of csac on every task."""
    rows = {row["id"]: row for row in _read("experiments.csv")}
    header = "Task | Final | Std | Best | Its std | Best policy's step (M) | Steps (M) | Seconds | Published"
    cells = []
    for name, final in rows.items():
        if _SUITE.fullmatch(name):
            chosen = rows[f"{name}@best"]
            task = f"{final['task']}-{final['version']}"
            scores = [_number(row[key]) for row in (final, chosen) for key in ("final_mean", "std")]
            steps = [f"{int(row['steps']) / 1e6:.1f}" for row in (chosen, final)]
            cells.append((task, *scores, *steps, _number(final["seconds"]), _number(str(REFERENCES[task][1]))))
    return _table(header, cells, numbers=range(1, 9))


def fill(text: str) -> str:
    """Replace every table of a page by its present form."""
    for name, table in {"best": best, "recipes": recipes, "suite": suite, "zoo": zoo.table}.items():
        begin, end = f"<!-- begin {name} -->\n", f"\n<!-- end {name} -->"
        if begin in text:
            text = text[: text.index(begin) + len(begin)] + table() + text[text.index(end) :]
    return text


def _read(name: str) -> list[dict[str, str]]:
    with (DOCS / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _table(header: str, rows: list[tuple[str, ...]], numbers: range) -> str:
    count = header.count("|") + 1
    rule = ["---:" if column in numbers else "---" for column in range(count)]
    return "\n".join([f"| {header} |", f"| {' | '.join(rule)} |", *(f"| {' | '.join(row)} |" for row in rows)])


def _number(text: str) -> str:
    """A number as tables show it; a dash for a value that was not recorded."""
    if not text:
        return "–"
    return format_score(float(text)) if "." in text else f"{int(text):,}"


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(fill(page.read_text(encoding="utf-8")), encoding="utf-8")
