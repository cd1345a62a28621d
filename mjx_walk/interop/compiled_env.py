"""Base of the Gymnasium environment and the vector environment: parts, description and pickling."""

from typing import Any

import gymnasium
import jax
from gymnasium.envs.mujoco import MujocoEnv

from mjx_walk.envs import State, TaskOptions
from mjx_walk.envs.model_changes import ModelSnapshot
from mjx_walk.envs.pickling import files_of, warn_of_changed_files
from mjx_walk.interop.gymnasium_programs import Programs, is_forked, make_programs, refuse_fork
from mjx_walk.interop.live_data import LiveData
from mjx_walk.interop.mujoco_attributes import make_gymnasium_env

__all__ = ["CompiledEnv"]


class CompiledEnv:
    """Compiled programs of a task, and an environment of Gymnasium that draws and renders."""

    _NOT_PICKLED: tuple[str, ...] = ("_gymnasium_env", "_snapshot", "_programs", "_data", "_read_data")

    _options: TaskOptions
    _physics: str
    _rendering: dict[str, object]
    _state: State | None
    _programs: Programs
    _gymnasium_env: MujocoEnv
    _read_data: list[LiveData]

    def _build(self) -> None:
        """Make the parts that are not pickled."""
        if not is_forked():  # a vectorizer may first ask a worker for its spaces
            self._programs = make_programs(self._options, self._physics)
        self._gymnasium_env = make_gymnasium_env(self._options, self._rendering)
        self._snapshot = ModelSnapshot(self._gymnasium_env.model)
        self._read_data = []

    def _describe(self) -> tuple[gymnasium.Space, gymnasium.Space]:
        """Take over Gymnasium's metadata and render mode. Returns its observation and action space."""
        env = self._gymnasium_env
        self.metadata = env.metadata | {"render_fps": round(1.0 / env.dt)}
        self.render_mode = env.render_mode
        return env.observation_space, env.action_space

    def _refuse_changes(self) -> None:
        """Check that neither the model nor `data` has been changed.

        Raises:
            UserError: one has.
        """
        self._snapshot.refuse_changes()
        self._refuse_changed_data()

    def _refuse_changed_data(self) -> None:
        for data in self._read_data:
            data._refuse_changes()

    def __getstate__(self) -> dict[str, object]:
        refuse_fork()
        state = {name: jax.device_get(value) for name, value in vars(self).items() if name not in self._NOT_PICKLED}
        return state | {"_read_files": files_of(self._programs.task)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        read_files = state.pop("_read_files")
        vars(self).update(state)
        self._build()
        warn_of_changed_files(read_files)
