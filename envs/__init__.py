"""Gymnasium's Humanoid, HumanoidStandup and Walker2d as pure functions."""

if __name__ != "mjx_walk.envs":  # a second copy of every class here would not match the first
    raise ImportError("import mjx_walk.envs, not envs")

import dataclasses
import difflib
from typing import Any

from mjx_walk.envs.humanoid import Humanoid, HumanoidOptions
from mjx_walk.envs.humanoid_standup import HumanoidStandup, HumanoidStandupOptions
from mjx_walk.envs.task import NO_TIME_LIMIT, State, Task, TaskOptions
from mjx_walk.envs.walker2d import Walker2d, Walker2dOptions
from mjx_walk.utils.compat import prepare_jax
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import validate

TASKS: dict[str, tuple[type[Task], type[TaskOptions]]] = {
    "humanoid": (Humanoid, HumanoidOptions),
    "humanoid_standup": (HumanoidStandup, HumanoidStandupOptions),
    "walker2d": (Walker2d, Walker2dOptions),
}

__all__ = ["NO_TIME_LIMIT", "TASKS", "State", "Task", "TaskOptions", "make_env"]


def make_env(name: str, physics: str = "auto", **kwargs: Any) -> Task:
    """Build one unbatched environment.

    Args:
        name: `humanoid`, `humanoid_standup` or `walker2d`.
        physics: `auto`, `warp`, `jax` or `c`.
        **kwargs: `version` (`v5` or `v4`), `max_episode_steps`, and Gymnasium's keywords for the task.

    Raises:
        UserError: an unknown name, engine, version or keyword.
    """
    prepare_jax()
    if name not in TASKS:
        raise UserError(f"unknown env '{name}'; choose one of: {', '.join(TASKS)}")
    task_class, options_class = TASKS[name]
    known = [field.name for field in dataclasses.fields(options_class) if field.name != "name"]
    for keyword in kwargs:
        if keyword not in known:
            near = difflib.get_close_matches(keyword, known, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise UserError(f"{name} has no keyword '{keyword}'; {hint}valid: {', '.join(known)}")
    options = options_class(**kwargs)
    validate(options)
    return task_class(options, physics)
