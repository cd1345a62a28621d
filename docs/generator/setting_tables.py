"""Tables of settings, from the dataclasses that declare them."""

import dataclasses
import itertools
from collections.abc import Sequence

from generator.markdown import code, first_sentence, table
from mjx_walk.algos import ALGORITHMS, BUILT_IN_ALGORITHMS
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.envs import TASKS
from mjx_walk.envs.ground.options import Ground
from mjx_walk.envs.option_presets import changes
from mjx_walk.envs.randomization.options import Randomization
from mjx_walk.envs.reward_shaping import Shaping
from mjx_walk.envs.task_options import OPTION_PRESETS, TaskOptions
from mjx_walk.settings.config import CheckpointConfig, Config
from mjx_walk.utils import setting_fields

GROUPS = {
    "run": (Config, ""),
    "evaluation": (EvaluationConfig, "evaluation."),
    "checkpoint": (CheckpointConfig, "checkpoint."),
    "task": (TaskOptions, "env."),
    "shaping": (Shaping, "env.shaping."),
    "randomize": (Randomization, "env.randomize."),
    "ground": (Ground, "env.ground."),
}
"""Groups of settings that do not depend on the task or the algorithm, with the start of their full keys."""


def settings_table(schema: type, prefix: str) -> str:
    """A table of all settings of a dataclass.

    Args:
        schema: the dataclass.
        prefix: start of the full keys, such as `algo.`.
    """
    meanings = setting_fields.meanings(schema)
    given = [row for row in setting_fields.table(schema) if row.name not in ("name", "env", "algo")]
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


def presets() -> str:
    """The settings of each preset of env options."""
    rows = []
    for group, presets in OPTION_PRESETS.items():
        for name, options in presets.items():
            given = {key: list(value) if isinstance(value, tuple) else value for key, value in changes(options).items()}
            rows.append([code(f"env.{group}={name}"), ", ".join(code(f"{key}={given[key]}") for key in given)])
    return table(["Preset", "Settings"], rows)


def task_tables(name: str) -> str:
    """The settings of a task that others do not have, with those of its own groups."""
    schema = TASKS[name][1]
    common = {field.name for field in dataclasses.fields(TaskOptions)} - {"frame_skip"}
    titles, rule, *rows = settings_table(schema, "env.").splitlines()
    own = [row for row in rows if row.split("`")[1].removeprefix("env.") not in common]
    groups = [settings_table(*group).splitlines()[2:] for group in own_groups(schema)]
    return "\n".join([titles, rule, *own, *itertools.chain(*groups)])


def own_groups(schema: type) -> list[tuple[type, str]]:
    """The groups of settings of a task that others do not have, with the start of their full keys."""
    common = {field.name for field in dataclasses.fields(TaskOptions)}
    fields = [field for field in dataclasses.fields(schema) if field.name not in common]
    kinds = {field.name: field.default_factory for field in fields if dataclasses.is_dataclass(field.default_factory)}
    return [(kind, f"env.{name}.") for name, kind in kinds.items()]


def algorithm_table(name: str) -> str:
    """The settings of an algorithm."""
    return settings_table(ALGORITHMS[name][1], "algo.")


def search_ranges() -> str:
    """The table of the ranges that a study searches by default."""
    owners: dict[tuple[str, str], list[str]] = {}
    for algo in BUILT_IN_ALGORITHMS:
        for field in dataclasses.fields(ALGORITHMS[algo][1]):
            search = field.metadata.get("search")
            if search:
                text = code(search) if isinstance(search, str) else _factors(search)
                owners.setdefault((f"algo.{field.name}", text), []).append(code(algo))
    rows = [[code(key), text, ", ".join(algos)] for (key, text), algos in owners.items()]
    return table(["Setting", "Values", "Algorithms"], rows)


def _factors(factors: Sequence[float]) -> str:
    *first, last = map(str, factors)
    return f"{', '.join(first)} and {last} times the recipe's value"


def algorithms(pages: dict[str, str]) -> str:
    """The table of all algorithms.

    Args:
        pages: the page of each algorithm, by its name.
    """
    rows = []
    for name, page in pages.items():
        data = "unrolls of the policy" if issubclass(ALGORITHMS[name][1], OnPolicyConfig) else "a replay buffer"
        rows.append([f"[`{name}`]({name}.md)", data, first_sentence(page)])
    return table(["`algo=`", "Learns from", "In short"], rows)


def all_schemas() -> list[type]:
    """Every dataclass of settings."""
    own = [schema for _, schema in (*TASKS.values(), *ALGORITHMS.values())]
    groups = [group for _, schema in TASKS.values() for group, _ in own_groups(schema)]
    return [*(schema for schema, _ in GROUPS.values()), *own, *groups]
