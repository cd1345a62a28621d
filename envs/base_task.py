"""Base of every task: what training, scores and run folders ask of it, whatever simulates it."""

import abc

from mjx_walk.envs.info import GymnasiumInfo
from mjx_walk.envs.physics.base import Simulator
from mjx_walk.envs.state import TrainableTask
from mjx_walk.envs.task_options import TaskOptions
from mjx_walk.utils.errors import UserError

__all__ = ["BaseTask", "no_model"]


class BaseTask(GymnasiumInfo, TrainableTask, abc.ABC):
    """A task of any simulator.

    `Task` has a MuJoCo model and an engine of this package. `interop.external_task` has other libraries' environments.
    """

    XML_FILES: dict[str, str | None]
    """Model file of each version, among Gymnasium's assets. None: the task has no model, and needs `xml_file`."""
    model_file: str = ""
    """Path or asset of the model; empty for a task without one."""
    engine: Simulator
    """What simulates the task."""
    model_sources: dict[str, str]
    """SHA-256 of the model's files, by path relative to its folder."""

    def __init__(self, options: TaskOptions, physics: str = "auto"):
        """
        Args:
            options: env options.
            physics: name of the engine, or `auto`.
        """
        self.options = options
        self.max_episode_steps = options.max_episode_steps

    @classmethod
    @abc.abstractmethod
    def resolve_physics(cls, physics: str) -> str:
        """The engine that `physics=` chooses on this machine, by the name that the run folder keeps.

        Raises:
            UserError: the task or this machine does not support it.
        """

    @property
    def reward_hashes(self) -> dict[str, str]:
        """SHA-256 of the reward function's files, by absolute path; empty without a reward function."""
        return {}

    @property
    def has_custom_reward(self) -> bool:
        """Whether the reward differs from Gymnasium's."""
        return False

    @property
    def terminates_on_fall(self) -> bool:
        """Whether a fall terminates the episode."""
        return False


def no_model(name: str, library: str) -> UserError:
    """The error of a command or setting that needs a MuJoCo model of this package.

    Args:
        name: of the task.
        library: that simulates it.
    """
    return UserError(
        f"{name} is simulated by {library}: physics=, films, play and export are for tasks with a MuJoCo model of this "
        "package; eval scores it"
    )
