"""The tasks by name: this package's own, and those that a user registers or names as `FILE.py:CLASS`."""

import re
import typing
from pathlib import Path

from mjx_walk.envs.ant import Ant, AntOptions
from mjx_walk.envs.base_task import BaseTask, no_model
from mjx_walk.envs.half_cheetah import HalfCheetah, HalfCheetahOptions
from mjx_walk.envs.hopper import Hopper, HopperOptions
from mjx_walk.envs.humanoid import Humanoid, HumanoidOptions
from mjx_walk.envs.humanoid_standup import HumanoidStandup, HumanoidStandupOptions
from mjx_walk.envs.inverted_double_pendulum import InvertedDoublePendulum, InvertedDoublePendulumOptions
from mjx_walk.envs.inverted_pendulum import InvertedPendulum, InvertedPendulumOptions
from mjx_walk.envs.locomotion import Locomotion, LocomotionOptions
from mjx_walk.envs.pusher import Pusher, PusherOptions
from mjx_walk.envs.reacher import Reacher, ReacherOptions
from mjx_walk.envs.swimmer import Swimmer, SwimmerOptions
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import TaskOptions
from mjx_walk.envs.user_files import changed_file, load_from_file
from mjx_walk.envs.walker2d import Walker2d, Walker2dOptions
from mjx_walk.utils.class_checks import check_class, check_decorated
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import with_name

__all__ = [
    "BUILT_IN_TASKS",
    "GYMNASIUM_TASKS",
    "TASKS",
    "is_registered_from",
    "register_task",
    "register_task_file",
    "require_model",
    "task_hashes",
    "task_name",
]

TASKS: dict[str, tuple[type[BaseTask], type[TaskOptions]]] = {
    "humanoid": (Humanoid, HumanoidOptions),
    "humanoid_standup": (HumanoidStandup, HumanoidStandupOptions),
    "walker2d": (Walker2d, Walker2dOptions),
    "ant": (Ant, AntOptions),
    "half_cheetah": (HalfCheetah, HalfCheetahOptions),
    "hopper": (Hopper, HopperOptions),
    "swimmer": (Swimmer, SwimmerOptions),
    "reacher": (Reacher, ReacherOptions),
    "pusher": (Pusher, PusherOptions),
    "inverted_pendulum": (InvertedPendulum, InvertedPendulumOptions),
    "inverted_double_pendulum": (InvertedDoublePendulum, InvertedDoublePendulumOptions),
    "locomotion": (Locomotion, LocomotionOptions),
}
BUILT_IN_TASKS: tuple[str, ...] = tuple(TASKS)
"""Names that a user's task cannot take."""
GYMNASIUM_TASKS: tuple[str, ...] = tuple(name for name, (task, _) in TASKS.items() if task.has_gymnasium_name())
"""The tasks of this package that have an equivalent in Gymnasium, and so a model of their own."""

_RESERVED = ("all",)
"""Values of `env=` with a meaning of their own."""

_files: dict[str, tuple[str, dict[str, str]]] = {}
"""For each task from a file: its `FILE.py:CLASS`, and the SHA-256 of the files that ran, by absolute path."""


def register_task(name: str, task: type[BaseTask], options: type[TaskOptions] | None = None) -> None:
    """Register a task, so that `env=NAME` and `make_env(NAME)` find it in this process.

    A class with the same module and name replaces a former one, as when a notebook's cell runs again.

    Args:
        name: lower-case letters, digits and underscores.
        task: a subclass of `Task` that defines all its abstract methods, or the result of `from_brax`.
        options: a dataclass derived from `TaskOptions`; by default the annotation of `task.options`, or `TaskOptions`.

    Raises:
        UserError: a name that is taken or invalid, or a class of another kind.
    """
    if name in _RESERVED:
        raise UserError(f"a task cannot be called '{name}', which has a meaning of its own; choose another name")
    if name in BUILT_IN_TASKS:
        raise UserError(f"'{name}' is a task of this package; choose another name")
    known = {other: kind for other, (kind, _) in TASKS.items()}
    check_class("a task", name, task, BaseTask, "a subclass of mjx_walk.envs.Task", known)
    for attribute in ("XML_FILES", "REWARD_TERMS"):
        if not isinstance(getattr(task, attribute, None), dict):
            raise UserError(f"the class {task.__name__} of the task '{name}' needs {attribute} = {{'v5': …}}")
    options = options or typing.get_type_hints(task).get("options", TaskOptions)
    _check_options(name, options)
    TASKS[name] = (task, with_name(options, name))


def register_task_file(source: str) -> str:
    """Run a Python file, and register one of its classes as a task. Returns the task's name.

    A file that has not changed does not run again. A class of the same name in another file replaces a former one.

    Args:
        source: `FILE.py:CLASS` with an absolute path.

    Raises:
        UserError: the file or the class is missing or invalid, or the name is taken.
    """
    for name, (known, hashes) in _files.items():
        if known == source and changed_file(hashes) is None:
            return name
    file = load_from_file("env.task", source, "CLASS")
    name, task = task_name(file.value), file.value
    if name in _files:
        del TASKS[name], _files[name]
    register_task(name, task)
    _files[name] = (source, file.hashes)
    return name


def require_model(task: BaseTask) -> Task:
    """The task itself, for what reads its MuJoCo model.

    Raises:
        UserError: it has none.
    """
    if isinstance(task, Task):
        return task
    raise no_model(task.options.name, task.engine.name)


def task_hashes(name: str) -> dict[str, str]:
    """SHA-256 of the files of a task from a file, by absolute path; empty for other tasks."""
    return _files[name][1] if name in _files else {}


def is_registered_from(name: str, source: str | None) -> bool:
    """Whether a task is registered, and comes from a file and class of these names, which may have moved.

    Args:
        name: of the task.
        source: `FILE.py:CLASS`, or None for a task that was registered from Python.
    """
    known = _files[name][0] if name in _files else None
    return name in TASKS and (source is None or (known is not None and Path(known).name == Path(source).name))


def task_name(task: object) -> str:
    """The name under which a class is registered: `MyRobot` becomes `my_robot`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", getattr(task, "__name__", str(task))).lower()


def _check_options(name: str, options: object) -> None:
    if not (isinstance(options, type) and issubclass(options, TaskOptions)):
        raise UserError(f"the options of the task '{name}' are {options!r}; give a dataclass derived from TaskOptions")
    check_decorated(options, f"options of the task '{name}'")
