"""Many environments in one program as a `VecEnv` of Stable-Baselines3."""

from collections.abc import Iterable
from typing import Any, NoReturn

import gymnasium
import jax
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from mjx_walk.envs.state import check_action_shape
from mjx_walk.interop.env_batch import BatchState, EnvBatch
from mjx_walk.utils.errors import UserError

__all__ = ["SB3Env", "VecMonitor"]


class SB3Env(VecEnv):
    """B environments with NumPy arrays, as Stable-Baselines3 wants them. The spaces are Gymnasium's."""

    def __init__(self, batch: EnvBatch):
        self._batch = batch
        self._state: BatchState | None = None
        self._actions: np.ndarray | None = None
        super().__init__(batch.num_envs, batch.observation_space("float64"), batch.action_space())

    def reset(self) -> np.ndarray:
        """Start an episode in each environment. The first seed of `seed` determines all starts."""
        self._state, obs = self._batch.reset(self._state, self._seeds[0])
        self._reset_seeds()
        return np.array(obs, np.float64)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions, `[B, action_size]`, for `step_wait`.

        Raises:
            ValueError: the actions have another shape.
        """
        check_action_shape(actions, (self.num_envs, self._batch.task.action_size))
        self._actions = np.array(actions, np.float32)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step all environments, and reset those whose episode ends.

        Returns:
            Observations after the resets, `[B, observation_size] f64`; rewards, `[B] f32`; `[B] bool`, where an
            episode ends; and `info`s. Those of ends have `terminal_observation` and `TimeLimit.truncated`.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state, step = self._batch.step(self._state, self._actions)
        obs, final_obs, reward, terminated, truncated = map(np.array, jax.device_get(step[:5]))
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i]["terminal_observation"] = final_obs[i].astype(np.float64)
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return obs.astype(np.float64), reward, done, infos

    def close(self) -> None:
        """Release the memory of the environments."""
        self._state = None

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """An attribute of the task, such as `dt`, once for each environment.

        Raises:
            AttributeError: the task has no such attribute.
        """
        value = None if attr_name == "render_mode" else getattr(self._batch.task, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: int | Iterable[int] | None = None) -> NoReturn:
        """
        Raises:
            UserError: always, since all environments are one program.
        """
        raise UserError(f"'{attr_name}' cannot be set: all environments are one program; give options to make_sb3_env")

    def env_method(
        self,
        method_name: str,
        *method_args: object,
        indices: int | Iterable[int] | None = None,
        **method_kwargs: object,
    ) -> NoReturn:
        """
        Raises:
            UserError: always, since all environments are one program.
        """
        raise UserError(
            f"'{method_name}' cannot be called: all environments are one program; make one "
            "environment with gymnasium.make"
        )

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Whether each environment has a wrapper: none has."""
        return [False for _ in self._get_indices(indices)]
