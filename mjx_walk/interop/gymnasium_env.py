"""The tasks as Gymnasium environments: `gymnasium.make("mjx_walk/Humanoid-v5")`.

They run on any engine (`physics=`), take Gymnasium's keywords, and behave as Gymnasium's own. Observations are float64
arrays, as there, that hold float32 values.
"""

from typing import Any

import gymnasium
import numpy as np

from mjx_walk.envs import NO_TIME_LIMIT, State, Task, make_options
from mjx_walk.envs.state import check_action_shape, in_same_episode
from mjx_walk.interop.compiled_env import CompiledEnv
from mjx_walk.interop.gymnasium_info import on_host, single_info
from mjx_walk.interop.gymnasium_programs import is_forked, refuse_fork
from mjx_walk.interop.live_data import Moment, Start
from mjx_walk.interop.mujoco_attributes import RENDER_MODES, MujocoAttributes, split_keywords

__all__ = ["MjxWalkEnv"]


class MjxWalkEnv(CompiledEnv, MujocoAttributes, gymnasium.Env):
    """One environment. `gymnasium.make` adds the time limit as a wrapper.

    In a forked process, it can be reset. All else raises an error, because JAX does not work there.
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
        self._host_state: State | None = None
        self._moment = Moment()
        self._build()
        self.observation_space, self.action_space = self._describe()

    def reset(self, *, seed: int | None = None, options: dict[str, object] | None = None):
        """Start an episode. A seed gives the start that it gives in Gymnasium, and determines all later episodes.

        Raises:
            UserError: the model or `data` has changed.
        """
        self._refuse_changes()
        super().reset(seed=seed)
        self._gymnasium_env.np_random = self.np_random
        obs, info = self._gymnasium_env.reset()  # with render_mode="human", it shows the frame as well
        if is_forked():
            # A vectorizer's worker reports errors of steps. One of a reset, while it makes the environment, ends it.
            return np.array(np.float32(obs), np.float64), info
        data = self._gymnasium_env.data
        self._state = self._programs.reset_to(np.float32(data.qpos), np.float32(data.qvel))
        self._host_state = state = on_host(self._state, data.qpos.copy(), data.qvel.copy())
        self._moment = Moment(state.physics)
        return np.array(state.obs, np.float64), single_info(self._task.reset_info(state))

    def step(self, action):
        """Step once.

        Args:
            action: `[action_size]`, in Gymnasium's units.

        Raises:
            ValueError: the action has another shape.
            UserError: the model or `data` has changed.
        """
        refuse_fork()
        self._refuse_changes()
        if self._state is None or self._host_state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        check_action_shape(action, (self._gymnasium_env.model.nu,))
        action = np.array(action, np.float32)
        start = Start(self._state.physics, self._state.draws, self._state.steps)
        before = self._host_state
        self._state = self._programs.step(self._state, action)
        self._host_state = state = on_host(self._state)
        if not state.metrics["nonfinite"]:  # else the physics stays as it was
            self._moment = Moment(state.physics, start, action)
        if self.render_mode == "human":
            self.render()
        reward = np.float64(self._programs.reward(state))
        info = single_info(self._task.step_info(before, state), state.metrics)
        return np.array(state.obs, np.float64), reward, bool(state.terminated), False, info

    def close(self) -> None:
        """Close the windows and OpenGL contexts."""
        self._close_gymnasium_env()

    @property
    def _task(self) -> Task:  # type: ignore[override]
        refuse_fork()
        return self._programs.task

    def _read_state(self) -> State | None:
        refuse_fork()
        return self._host_state

    def _read_moment(self) -> Moment:
        return self._moment

    def _write_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        refuse_fork()
        self._refuse_changed_data()
        # As in Gymnasium, the solver's initial guess and activations stay.
        old = self._state
        kept = () if old is None else (old.physics.qacc_warmstart, old.physics.act)
        new = self._programs.reset_to(np.float32(qpos), np.float32(qvel), *kept)
        self._state = new if old is None else in_same_episode(old, new)
        self._host_state = on_host(self._state, qpos, qvel)
        self._moment = self._moment._replace(placed=(qpos, qvel))

    def __getstate__(self) -> dict[str, object]:
        return super().__getstate__() | {"_init": (self.init_qpos, self.init_qvel)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        init = state.pop("_init")
        super().__setstate__(state)
        self.init_qpos, self.init_qvel = init
