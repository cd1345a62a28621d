"""The recipes among the configuration files, and the file that stands for a recipe without one.

`configs/train.yaml` chooses `HARDWARE/ENV_ALGO`. Without a file of its own, that recipe takes the settings of
`HARDWARE/ALGO`, the defaults there.
"""

from pathlib import Path

from mjx_walk.algos import ALGORITHMS, BUILT_IN_ALGORITHMS
from mjx_walk.envs import BUILT_IN_TASKS, TASKS

__all__ = ["CONFIG_DIR", "HARDWARE", "fallback", "fitting_recipes", "has_file", "recipe_names"]

CONFIG_DIR = str(Path(__file__).parents[1] / "configs")
"""Folder of the Hydra groups and recipes."""

HARDWARE = ("cpu", "gpu")
"""Values of `hardware=`."""


def recipe_names() -> list[str]:
    """Valid values of `recipe=`, such as `cpu/humanoid_ppo`."""
    folder = Path(CONFIG_DIR) / "recipe"
    names = {str(path.relative_to(folder).with_suffix("")) for path in folder.glob("**/[!_]*.yaml")}
    return sorted(names | {f"{size}/{env}_{algo}" for size in HARDWARE for env in TASKS for algo in ALGORITHMS})


def has_file(name: str) -> bool:
    """Whether a recipe of this package has a file of its own."""
    return (Path(CONFIG_DIR) / "recipe" / f"{name}.yaml").is_file()


def fallback(name: str) -> str | None:
    """The recipe from which `HARDWARE/ENV_ALGO` without a file takes its settings. None for other names.

    A task or an algorithm without files takes those of the class from which it derives. A task that derives from none
    takes the algorithm's defaults. An algorithm that derives from none takes no recipe, `""`.
    """
    if has_file(name):
        return None
    size, _, both = name.partition("/")
    pairs = (both.removesuffix(f"_{algo}") for algo in ALGORITHMS if both.endswith(f"_{algo}"))
    env = next((env for env in pairs if env in TASKS), None)
    if size not in HARDWARE or env is None:
        return None
    tasks = {TASKS[known][0]: known for known in BUILT_IN_TASKS}
    configs = {ALGORITHMS[known][1]: known for known in BUILT_IN_ALGORITHMS}
    task = next((tasks[kind] for kind in TASKS[env][0].__mro__ if kind in tasks), None)
    kinds = ALGORITHMS[both.removeprefix(f"{env}_")][1].__mro__
    algos = [configs[kind] for kind in kinds if kind in configs]
    return next((f for algo in algos for f in (f"{size}/{task}_{algo}", f"{size}/{algo}") if has_file(f)), "")


def fitting_recipes(env: str, algo: str) -> str:
    """The recipes for an environment and an algorithm, in words."""
    names = [name for name in recipe_names() if name.endswith(f"/{env}_{algo}")]
    return f"recipes for env={env} algo={algo}: {', '.join(names)}"
