"""Gymnasium's MuJoCo tasks as pure functions, with their rewards and vectorization.

Reset, step, autoreset and evaluation in the training batch belong here, and the physics engines in `physics/`.
Policies, learning and other libraries' environment interfaces (`interop`) do not.
"""

if __name__ != "mjx_walk.envs":  # a second import under another name would duplicate every class
    raise ImportError("import mjx_walk.envs, not envs")

import dataclasses
from typing import Any

from mjx_walk.envs.base_task import BaseTask
from mjx_walk.envs.registry import BUILT_IN_TASKS, GYMNASIUM_TASKS, TASKS, register_task, require_model
from mjx_walk.envs.state import NO_TIME_LIMIT, State, TrainableTask
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import TaskOptions, with_absolute_paths
from mjx_walk.envs.view import View
from mjx_walk.machine.compat import prepare_jax
from mjx_walk.storage.files import working_folder
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import near_misses, unknown
from mjx_walk.utils.setting_fields import validate

__all__ = [
    "BUILT_IN_TASKS",
    "GYMNASIUM_TASKS",
    "NO_TIME_LIMIT",
    "TASKS",
    "BaseTask",
    "State",
    "Task",
    "TaskOptions",
    "TrainableTask",
    "View",
    "make_env",
    "make_options",
    "register_task",
    "require_model",
    "with_absolute_paths",
]


def make_env(name: str, physics: str = "auto", **kwargs: object) -> Task:
    """Create one unbatched environment.

    Args:
        name: a key of `TASKS`, such as `humanoid`, or the name of a registered task.
        physics: `auto`, `warp`, `jax` or `c`.
        **kwargs: env options: `version` (`v5` or `v4`), `max_episode_steps`, `shaping`, `reward_function`, and the
            keyword arguments of the Gymnasium class.

    Raises:
        UserError: an unknown name, engine, version or option, an invalid value, or an environment of another library.
    """
    prepare_jax()
    options = make_options(name, **kwargs)
    return require_model(TASKS[name][0](options, physics))


def make_options(name: str, **kwargs: Any) -> TaskOptions:
    """Env options of a task, checked. See `make_env`.

    Raises:
        UserError: an unknown name or option, or an invalid value.
    """
    if not isinstance(name, str) or name not in TASKS:
        raise UserError(unknown("env", str(name), TASKS))
    options_class = TASKS[name][1]
    known = [field.name for field in dataclasses.fields(options_class) if field.name not in ("name", "task")]
    for option in kwargs:
        if option not in known:
            near = near_misses(option, known, 1, 0.6)
            hint = f"did you mean '{near[0]}'?" if near else f"valid: {', '.join(known)}"
            raise UserError(f"{name} has no option '{option}'; {hint}")
    options = options_class(**kwargs)
    validate(options)
    return with_absolute_paths(options, working_folder())
