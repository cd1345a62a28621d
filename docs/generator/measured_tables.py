"""Tables of the files in measured/: speeds, times, memory, scores on a CPU, and the tables of the archive.

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


def all_in(folder: str) -> dict[str, str]:
    """The tables of a folder, by the names of their files.

    Args:
        folder: relative to measured/.
    """
    return {path.stem: _drawn(path) for path in sorted((FOLDER / folder).glob("*.csv"))}


def _drawn(path: Path) -> str:
    if path.stem in _JOINED:
        return _complete_runs()
    titles, *rows = _cells(path)
    columns = list(zip(*rows, strict=True))
    right = [">" * all(map(_is_number, column)) for column in columns]
    aligned = [mark + title for mark, title in zip(right, titles, strict=True)]
    return table(aligned, [[_shown(cell) for cell in row] for row in rows])


def _complete_runs() -> str:
    """Training runs of PPO on Humanoid."""
    log = {(row["id"], row["measure"]): row for row in read("experiments.csv")}
    rows = []
    for run in read("measured/complete_runs.csv"):
        speed, score = log[run["id"], "speed"], log[run["id"], "gymnasium"]
        cells = [run["recipe"], run["seed"], number(run["num_envs"]), number(speed["final_mean"]), score["seconds"]]
        cells += [number(run["process_seconds"]), _shown(run["programs"])]
        rows.append([*cells, number(score["final_mean"]), score["std"]])
    titles = ("Recipe", ">Seed", ">Environments", ">Steps/s", ">Training (s)", ">Process (s)", "JAX's programs")
    return table((*titles, ">Score", ">Std over episodes"), rows)


def _cells(path: Path) -> list[list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file, strict=True))


def _is_number(cell: str) -> bool:
    return not cell or re.match(r"-?\d", cell) is not None


def _shown(cell: str) -> str:
    if not re.fullmatch(r"-?\d+(\.\d+)?", cell):
        return cell or "–"
    integer, point, fraction = cell.partition(".")
    return f"{int(integer):,}{point}{fraction}" if abs(int(integer)) >= 1000 else cell
