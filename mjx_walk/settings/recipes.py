"""The recipes among the configuration files, and which one applies to a task and an algorithm."""

from pathlib import Path

from mjx_walk.algos import ALGORITHMS, BUILT_IN_ALGORITHMS
from mjx_walk.envs import BUILT_IN_TASKS, TASKS

__all__ = ["CONFIG_DIR", "base_recipe", "fitting_recipes", "recipe_names"]

CONFIG_DIR = str(Path(__file__).parents[1] / "configs")
"""Folder of the Hydra groups and recipes."""

_BASE_TASK = "walker2d"
"""Task whose recipes apply to tasks of users that derive from no other task."""


def recipe_names() -> list[str]:
    """Valid values of `recipe=`, such as `cpu/humanoid_ppo`."""
    folder = Path(CONFIG_DIR) / "recipe"
    return sorted(str(path.relative_to(folder).with_suffix("")) for path in folder.glob("**/[!_]*.yaml"))


def base_recipe(env: str, algo: str, hardware: str) -> str | None:
    """The recipe for a task or an algorithm that a user has registered. None for those of this package.

    It is the recipe of the task and the algorithm of this package from which the classes derive. A task that derives
    from none takes Walker2d's. An algorithm that derives from none takes no recipe, `null`.
    """
    if env in BUILT_IN_TASKS and algo in BUILT_IN_ALGORITHMS:
        return None
    tasks = {TASKS[name][0]: name for name in BUILT_IN_TASKS}
    configs = {ALGORITHMS[name][1]: name for name in BUILT_IN_ALGORITHMS}
    task = next((tasks[kind] for kind in TASKS[env][0].__mro__ if kind in tasks), _BASE_TASK)
    algorithm = next((configs[kind] for kind in ALGORITHMS[algo][1].__mro__ if kind in configs), None)
    return f"{hardware}/{task}_{algorithm}" if algorithm else "null"


def fitting_recipes(env: str, algo: str) -> str:
    """The recipes for an environment and an algorithm, in words."""
    names = [name for name in recipe_names() if name.endswith(f"/{env}_{algo}")]
    return f"recipes for env={env} algo={algo}: {', '.join(names)}"
