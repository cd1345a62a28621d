"""Gymnasium's Humanoid, HumanoidStandup and Walker2d as pure functions, with their rewards and vectorization.

Reset, step, autoreset and evaluation in the training batch belong here, and the physics engines in `physics/`.
Policies, learning and other libraries' environment interfaces (`interop`) do not.
"""

if __name__ != "mjx_walk.envs":  # a second import under another name would duplicate every class
    raise ImportError("import mjx_walk.envs, not envs")

import dataclasses
import difflib
from pathlib import Path
from typing import Any

from mjx_walk.envs.humanoid import Humanoid, HumanoidOptions
from mjx_walk.envs.humanoid_standup import HumanoidStandup, HumanoidStandupOptions
from mjx_walk.envs.task import NO_TIME_LIMIT, State, Task, TaskOptions, TrainableTask, with_absolute_paths
from mjx_walk.envs.walker2d import Walker2d, Walker2dOptions
from mjx_walk.utils.compat import prepare_jax
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import validate

TASKS: dict[str, tuple[type[Task], type[TaskOptions]]] = {
    "humanoid": (Humanoid, HumanoidOptions),
    "humanoid_standup": (HumanoidStandup, HumanoidStandupOptions),
    "walker2d": (Walker2d, Walker2dOptions),
}

__all__ = ["NO_TIME_LIMIT", "TASKS", "State", "Task", "TaskOptions", "TrainableTask", "make_env", "with_absolute_paths"]


def make_env(name: str, physics: str = "auto", **kwargs: Any) -> Task:
    """Create one unbatched environment.

    Args:
        name: `humanoid`, `humanoid_standup` or `walker2d`.
        physics: `auto`, `warp`, `jax` or `c`.
        **kwargs: env options: `version` (`v5` or `v4`), `max_episode_steps`, `shaping`, `reward_function`, and the
            keyword arguments of the Gymnasium class.

    Raises:
        UserError: an unknown name, engine, version or option, or an invalid value.
    """
    prepare_jax()
    if name not in TASKS:
        raise UserError(f"unknown env '{name}'; choose one of: {', '.join(TASKS)}")
    task_class, options_class = TASKS[name]
    known = [field.name for field in dataclasses.fields(options_class) if field.name != "name"]
    for option in kwargs:
        if option not in known:
            near = difflib.get_close_matches(option, known, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise UserError(f"{name} has no option '{option}'; {hint}valid: {', '.join(known)}")
    options = with_absolute_paths(options_class(**kwargs), Path.cwd())
    validate(options)
    return task_class(options, physics)
