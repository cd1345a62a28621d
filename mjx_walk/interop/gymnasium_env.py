"""The tasks as Gymnasium environments: `gymnasium.make("mjx_walk/Humanoid-v5")`.

They run on any engine (`physics=`), take Gymnasium's keywords, and behave as Gymnasium's own. Observations are float64
arrays, as there, that hold float32 values.
"""

from typing import Any

import gymnasium
import jax
import numpy as np

from mjx_walk.envs import NO_TIME_LIMIT, State, make_options
from mjx_walk.envs.state import check_action_shape, in_same_episode
from mjx_walk.interop.compiled_env import CompiledEnv
from mjx_walk.interop.gymnasium_info import single_info
from mjx_walk.interop.gymnasium_programs import refuse_fork
from mjx_walk.interop.mujoco_attributes import RENDER_MODES, MujocoAttributes, split_keywords

__all__ = ["MjxWalkEnv"]


class MjxWalkEnv(CompiledEnv, MujocoAttributes, gymnasium.Env):
    """One environment. `gymnasium.make` adds the time limit as a wrapper.

    Copies and pickles keep the state and the random generator.
    """

    metadata = {"render_modes": list(RENDER_MODES)}

    def __init__(self, env: str, physics: str = "auto", **keywords: object):
        """
        Args:
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions`.

        Raises:
            UserError: an unknown name, engine or keyword.
        """
        options, self._rendering = split_keywords(keywords)
        self._options = make_options(env, **options | {"max_episode_steps": NO_TIME_LIMIT})
        self._physics = physics
        self._state: State | None = None
        self._build()
        self.observation_space, self.action_space = self._describe()

    def reset(self, *, seed: int | None = None, options: dict[str, object] | None = None):
        """Start an episode. A seed gives the start that it gives in Gymnasium, and determines all later episodes.

        Raises:
            UserError: the model has changed.
        """
        refuse_fork()
        self._snapshot.refuse_changes()
        super().reset(seed=seed)
        self._gymnasium_env.np_random = self.np_random
        self._gymnasium_env.reset()  # with render_mode="human", it shows the frame as well
        data = self._gymnasium_env.data
        self._state, info = self._programs.reset_to(np.float32(data.qpos), np.float32(data.qvel))
        return np.array(self._state.obs, np.float64), single_info(jax.device_get(info))

    def step(self, action):
        """Step once.

        Args:
            action: `[action_size]`, in Gymnasium's units.

        Raises:
            ValueError: the action has another shape.
            UserError: the model has changed.
        """
        refuse_fork()
        self._snapshot.refuse_changes()
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        check_action_shape(action, (self._gymnasium_env.model.nu,))
        self._state, info = self._programs.step(self._state, np.asarray(action, np.float32))
        state, info = jax.device_get((self._state, info))
        if self.render_mode == "human":
            self.render()
        reward = np.float64(self._programs.reward(state))
        info = single_info(info, state.metrics)
        return np.array(state.obs, np.float64), reward, bool(state.terminated), False, info

    def close(self) -> None:
        """Close the windows and OpenGL contexts."""
        self._close_gymnasium_env()

    def _read_state(self) -> State | None:
        return self._state

    def _write_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        refuse_fork()
        # As in Gymnasium, the solver's initial guess and activations stay.
        old = self._state
        kept = () if old is None else (old.physics.qacc_warmstart, old.physics.act)
        new, _ = self._programs.reset_to(qpos, qvel, *kept)
        self._state = new if old is None else in_same_episode(old, new)

    def __getstate__(self) -> dict[str, object]:
        return super().__getstate__() | {"_init": (self.init_qpos, self.init_qvel)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        init = state.pop("_init")
        super().__setstate__(state)
        self.init_qpos, self.init_qvel = init
