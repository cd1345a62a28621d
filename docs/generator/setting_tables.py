"""Tables of settings, from the dataclasses that declare them."""

import re
from pathlib import Path

from generator.markdown import code, table
from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.envs.reward_shaping import Shaping
from mjx_walk.envs.task_options import TaskOptions
from mjx_walk.runs.config import CheckpointConfig, Config
from mjx_walk.utils import settings

GROUPS = {
    "run": (Config, ""),
    "evaluation": (EvaluationConfig, "evaluation."),
    "checkpoint": (CheckpointConfig, "checkpoint."),
    "task": (TaskOptions, "env."),
    "shaping": (Shaping, "env.shaping."),
}
"""Groups of settings that do not depend on the task or the algorithm, with the start of their full keys."""

_RESULTS = Path(__file__).parent.parent / "results.md"


def settings_table(schema: type, prefix: str) -> str:
    """A table of all settings of a dataclass.

    Args:
        schema: the dataclass.
        prefix: start of the full keys, such as `algo.`.
    """
    meanings = settings.meanings(schema)
    given = [row for row in settings.table(schema) if row.name not in ("name", "env", "algo")]
    rows = []
    for row in given:
        conditions = " or ".join(map(_condition, row.condition.split(" or "))) if row.condition else ""
        meaning = meanings[row.name] + (f" Only with {conditions}." if conditions else "")
        rows.append([code(prefix + row.name), code(row.default), row.valid.replace("|", ", "), meaning])
    return table(["Setting", "Default", "Valid", "Meaning"], rows)


def _condition(text: str) -> str:
    """`x=1` or `x other than 1`, as code."""
    name, other, value = text.partition(" other than ")
    return f"{code(name)}{other}{code(value)}"


def group_table(name: str) -> str:
    """The table of one of `GROUPS`."""
    return settings_table(*GROUPS[name])


def algorithm_table(name: str) -> str:
    """The settings of an algorithm."""
    return settings_table(ALGORITHMS[name][1], "algo.")


def score_table(name: str) -> str:
    """The rows of an algorithm in the table of scores in results.md, with the cells that a reader compares.

    Raises:
        ValueError: the table has other columns than expected.
    """
    text = _RESULTS.read_text().partition("## Scores of all recipes")[2].partition("\n## ")[0]
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    titles, rows = lines[0], lines[2:]
    wanted = ("Task", "Algorithm", "Score", "Std", "Seeds", "Steps (M)", "Command")
    columns = [titles.index(title) for title in wanted]
    own = [row for row in rows if re.match(rf"{name}\b", row[titles.index("Algorithm")], flags=re.IGNORECASE)]
    aligned = [f">{title}" if title in ("Score", "Std", "Seeds", "Steps (M)") else title for title in wanted]
    return table(aligned, [[row[column] for column in columns] for row in own])


def all_schemas() -> list[type]:
    """Every dataclass of settings."""
    own = [schema for _, schema in (*TASKS.values(), *ALGORITHMS.values())]
    return [*(schema for schema, _ in GROUPS.values()), *own]
