"""The tasks as Gymnasium environments: `gymnasium.make("mjx_walk/Humanoid-v5")`.

They run on any engine (`physics=`) and take Gymnasium's keywords. Observations and rewards are float32.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mjx_walk.envs import NO_TIME_LIMIT, State, Task, make_env


class MjxWalkEnv(gymnasium.Env):
    """One environment. `gymnasium.make` adds the time limit as a wrapper."""

    metadata = {"render_modes": []}

    def __init__(self, env: str, physics: str = "auto", **keywords: Any):
        """
        Args:
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions`.
        """
        task = make_env(env, physics, **keywords | {"max_episode_steps": NO_TIME_LIMIT})
        self.observation_space, self.action_space = _spaces(task)
        self._reset, self._step = jax.jit(task.reset), jax.jit(task.step)
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode at random. `seed` also determines all later episodes."""
        super().reset(seed=seed)
        self._state = self._reset(_draw_key(self.np_random))
        return np.asarray(self._state.obs), {}

    def step(self, action):
        """Step once. `info` holds the reward terms."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state = self._step(self._state, jnp.asarray(action, jnp.float32))
        state = jax.device_get(self._state)
        info = {name: float(value) for name, value in state.metrics.items()}
        return state.obs, float(state.reward), bool(state.terminated), False, info


class MjxWalkVectorEnv(gymnasium.vector.VectorEnv):
    """Many environments in one compiled program.

    Finished environments reset in the same step. Their last observation is in `info["final_obs"]`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, num_envs: int, env: str, physics: str = "auto", **keywords: Any):
        """
        Args:
            num_envs: number of environments, B.
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions`.
        """
        self.num_envs = num_envs
        self._task = make_env(env, physics, **keywords)
        self.single_observation_space, self.single_action_space = _spaces(self._task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = jax.jit(jax.vmap(self._task.reset)), jax.jit(self._step_and_reset)
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start all episodes at random. `seed` also determines all later episodes."""
        super().reset(seed=seed)
        self._state = self._reset(self._draw_keys())
        return np.asarray(self._state.obs), {}

    def step(self, actions):
        """Step all environments. `info` holds the reward terms, `[B]` each."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state, before_reset = self._step(self._state, jnp.asarray(actions, jnp.float32), self._draw_keys())
        last = jax.device_get(before_reset)
        is_over = last.terminated | last.truncated
        info: dict[str, Any] = dict(last.metrics)
        if is_over.any():
            # Gymnasium's own vector environments have this layout: one object per environment, None while it runs.
            final_obs = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(is_over):
                final_obs[i] = last.obs[i]
            info |= {"final_obs": final_obs, "_final_obs": is_over}
            info |= {"final_info": dict(last.metrics), "_final_info": is_over}
        return np.asarray(self._state.obs), last.reward, last.terminated, last.truncated, info

    def _draw_keys(self) -> jax.Array:
        return jax.random.split(_draw_key(self.np_random), self.num_envs)

    def _step_and_reset(self, state: State, action: jax.Array, keys: jax.Array) -> tuple[State, State]:
        """Step all environments; the states after and before finished ones are reset, `[B, …]`."""
        last = jax.vmap(self._task.step)(state, action)
        is_over = last.terminated | last.truncated

        def reset_finished(state: State) -> State:
            return jax.vmap(_select)(is_over, jax.vmap(self._task.reset)(keys), state)

        return jax.lax.cond(is_over.any(), reset_finished, lambda state: state, last), last


def _select(condition: jax.Array, new: State, old: State) -> State:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)


def _draw_key(rng: np.random.Generator) -> jax.Array:
    return jax.random.PRNGKey(int(rng.integers(2**31)))


def _spaces(task: Task) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Observation and action space of one environment."""
    low, high = np.asarray(task.action_low), np.asarray(task.action_high)
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)
    return observations, gymnasium.spaces.Box(low, high, dtype=np.float32)
