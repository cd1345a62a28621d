"""Tables of measured/*.csv: speeds, times, memory, and scores on a CPU.

A file has a table's titles and rows. An empty cell was not measured.
"""

import csv
import re
from pathlib import Path

from generator.markdown import table
from generator.score_tables import number, read

FOLDER = Path(__file__).parent.parent / "measured"
_JOINED = ("complete_runs",)
"""Files whose rows are completed from experiments.csv."""


def names() -> list[str]:
    """Names of the tables, which are those of their files."""
    return sorted(path.stem for path in FOLDER.glob("*.csv"))


def drawn(name: str) -> str:
    """A table of the folder."""
    if name in _JOINED:
        return _complete_runs()
    titles, *rows = _cells(name)
    columns = list(zip(*rows, strict=True))
    aligned = [f">{title}" if all(map(_is_number, column)) else title for title, column in zip(titles, columns, strict=True)]
    return table(aligned, [[_shown(cell) for cell in row] for row in rows])


def _complete_runs() -> str:
    """Training runs of PPO on Humanoid, each alone on a GPU."""
    log: dict[tuple[str, str], dict[str, str]] = {(row["id"], row["measure"]): row for row in read("experiments.csv")}
    rows = []
    for run in read("measured/complete_runs.csv"):
        speed, score = log[run["id"], "speed"], log[run["id"], "gymnasium"]
        cells = [run["recipe"], run["seed"], number(run["num_envs"]), number(speed["final_mean"]), score["seconds"]]
        rows.append([*cells, run["process_seconds"], run["programs"], number(score["final_mean"]), score["std"]])
    titles = ("Recipe", ">Seed", ">Environments", ">Steps/s", ">Training (s)", ">Process (s)", "JAX's programs")
    return table((*titles, ">Score", ">Std over episodes"), rows)


def _cells(name: str) -> list[list[str]]:
    with (FOLDER / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file, strict=True))


def _is_number(cell: str) -> bool:
    return not cell or re.match(r"-?\d", cell) is not None


def _shown(cell: str) -> str:
    return f"{int(cell):,}" if re.fullmatch(r"-?\d+", cell) else cell or "–"
