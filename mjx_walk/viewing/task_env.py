"""A task of a user as a Gymnasium environment with a MuJoCo simulation to draw."""

import copy

import gymnasium
import jax
import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

from mjx_walk.envs import State, Task

__all__ = ["TaskEnv"]


class TaskEnv(gymnasium.Env):
    """Steps a task, and copies its physics state to `data`. It has the attributes of Gymnasium's `MujocoEnv`."""

    def __init__(self, task: Task, render_mode: str | None = None, width: int = 480, height: int = 480):
        """
        Args:
            task: the task.
            render_mode: `rgb_array`, or None.
            width: of the frames.
            height: of the frames.
        """
        self.render_mode = render_mode
        self.dt = task.dt
        self.model = copy.deepcopy(task.model)  # films change colors and floors
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
        self.data = mujoco.MjData(self.model)
        self.mujoco_renderer = MujocoRenderer(self.model, self.data, width=width, height=height)
        self._task = task
        self._reset, self._step = jax.jit(task.reset), jax.jit(task.step)
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, object] | None = None):
        """Start an episode at random."""
        super().reset(seed=seed)
        self._state = self._reset(jax.random.PRNGKey(seed or 0))
        self._show(np.zeros(self.model.nu))
        return np.asarray(self._state.obs), {}

    def step(self, action: np.ndarray):
        """Step once. `info` holds the reward terms."""
        assert self._state is not None
        self._state = self._step(self._state, np.float32(action))
        self._show(action)
        state = jax.device_get(self._state)
        info = {name: float(value) for name, value in state.metrics.items()}
        return state.obs, float(state.reward), bool(state.terminated), bool(state.truncated), info

    def render(self):
        """The frame `[height, width, 3] u8`."""
        return self.mujoco_renderer.render(self.render_mode)

    def close(self) -> None:
        self.mujoco_renderer.close()

    def _show(self, action: np.ndarray) -> None:
        """Copy the physics state to `data`, and compute what is drawn from it."""
        assert self._state is not None
        physics = self._state.physics
        self.data.qpos[:], self.data.qvel[:] = physics.qpos, physics.qvel
        if physics.act is not None:
            self.data.act[:] = physics.act
        self.data.ctrl[:] = action
        mujoco.mj_forward(self.model, self.data)
