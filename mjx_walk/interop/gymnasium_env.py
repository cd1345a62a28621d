"""The tasks as Gymnasium environments, for code that speaks its interface: `gymnasium.make("mjx_walk/Humanoid-v5")`.

They run on any engine (`physics=`), take Gymnasium's keywords, and are rewarded and observed in float32.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mjx_walk.envs import NO_TIME_LIMIT, State, Task, make_env


class SingleEnv(gymnasium.Env):
    """One copy. Its time limit is the wrapper that `gymnasium.make` puts around it."""

    metadata = {"render_modes": []}

    def __init__(self, env: str, physics: str = "auto", **keywords: Any):
        """
        Args:
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions`.
        """
        self._task = make_env(env, physics, **keywords | {"max_episode_steps": NO_TIME_LIMIT})
        self.observation_space, self.action_space = _spaces(self._task)
        self._reset, self._step = jax.jit(self._task.reset), jax.jit(self._task.step)
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """A random start; `seed` decides all that follow, too."""
        super().reset(seed=seed)
        self._state = self._reset(jax.random.PRNGKey(int(self.np_random.integers(2**31))))
        return np.asarray(self._state.obs), {}

    def step(self, action):
        """One step; `info` has the reward terms."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state = self._step(self._state, jnp.asarray(action, jnp.float32))
        state = jax.device_get(self._state)
        info = {name: float(value) for name, value in state.metrics.items()}
        return state.obs, float(state.reward), bool(state.terminated), False, info


class ManyEnvs(gymnasium.vector.VectorEnv):
    """Many copies side by side in one program. A copy whose episode ends begins the next one in the same step; the last
    observation is in `info["final_obs"]`."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, num_envs: int, env: str, physics: str = "auto", **keywords: Any):
        """
        Args:
            num_envs: copies, B.
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions`.
        """
        self.num_envs = num_envs
        task = make_env(env, physics, **keywords)
        self.single_observation_space, self.single_action_space = _spaces(task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        resets = jax.vmap(task.reset)

        def step(state: State, action: jax.Array, keys: jax.Array) -> tuple[State, State]:
            state = jax.vmap(task.step)(state, action)
            is_over = state.terminated | state.truncated

            def begin_again(state: State) -> State:
                fresh = resets(keys)
                return jax.tree.map(
                    lambda new, old: jnp.where(is_over.reshape((-1, *[1] * (old.ndim - 1))), new, old), fresh, state
                )

            return jax.lax.cond(is_over.any(), begin_again, lambda state: state, state), state

        self._resets, self._step = jax.jit(resets), jax.jit(step)
        self._state: State | None = None

    def _keys(self) -> jax.Array:
        return jax.random.split(jax.random.PRNGKey(int(self.np_random.integers(2**31))), self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Random starts of all copies; `seed` decides all that follow, too."""
        super().reset(seed=seed)
        self._state = self._resets(self._keys())
        return np.asarray(self._state.obs), {}

    def step(self, actions):
        """One step of all; `info` has the reward terms, `[B]` each."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state, before = self._step(self._state, jnp.asarray(actions, jnp.float32), self._keys())
        last = jax.device_get(before)
        is_over = last.terminated | last.truncated
        info: dict[str, Any] = dict(last.metrics)
        if is_over.any():
            # As Gymnasium's own vector environments give them: an object for each copy, None where none has ended.
            final = np.full(self.num_envs, None, dtype=object)
            for copy in np.flatnonzero(is_over):
                final[copy] = last.obs[copy]
            info |= {"final_obs": final, "_final_obs": is_over}
            info |= {"final_info": dict(last.metrics), "_final_info": is_over}
        return np.asarray(self._state.obs), last.reward, last.terminated, last.truncated, info


def _spaces(task: Task) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Of one copy's observations and actions."""
    low, high = np.asarray(task.action_low), np.asarray(task.action_high)
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)
    return observations, gymnasium.spaces.Box(low, high, dtype=np.float32)
