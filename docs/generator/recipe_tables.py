"""What recipes of single tasks change in the recipe that an algorithm's tasks share."""

from pathlib import Path

from generator.markdown import code, table
from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import GYMNASIUM_TASKS
from mjx_walk.settings.config import Config, flatten
from mjx_walk.settings.recipe_files import recipe_settings
from mjx_walk.settings.recipes import CONFIG_DIR
from mjx_walk.utils.setting_fields import in_yaml

_RECIPES = Path(CONFIG_DIR) / "recipe" / "gpu"


def differences(algo: str) -> str:
    """The settings in which tasks differ from the algorithm's own recipe for a GPU, with their number."""
    shared = _settings(algo, _RECIPES / f"{algo}.yaml")
    rows = []
    for task in GYMNASIUM_TASKS:
        file = _RECIPES / f"{task}_{algo}.yaml"
        given = _settings(algo, file) if file.exists() else shared
        changed = [key for key in given if given[key] != shared[key]]
        rows += [[code(task), *map(code, (key, in_yaml(shared[key]), in_yaml(given[key])))] for key in changed]
    tasks = len({task for task, *_ in rows})
    differing = f"{len(rows)} settings on {tasks} of {len(GYMNASIUM_TASKS)} tasks"
    summary = f"All tasks share `recipe=gpu/{algo}`, apart from {differing}:"
    return f"{summary}\n\n{table(['Task', 'Setting', '>All tasks', '>This task'], rows)}"


def _settings(algo: str, file: Path) -> dict[str, object]:
    """The settings of a recipe, and the defaults of the others."""
    return flatten(Config(algo=ALGORITHMS[algo][1]())) | {key: value for _, key, value in recipe_settings(file)}
