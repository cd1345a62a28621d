"""A task in gymnax's interface, for rejax, PureJaxRL and other trainers that are written against it."""

import functools
import math
from typing import NamedTuple

import flax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_walk.envs import State, make_env
from mjx_walk.envs.physics.base import batch_once
from mjx_walk.machine.compat import standard_dtypes

__all__ = ["Box", "EnvParams", "GymnaxEnv"]

_ENVS_PER_RESET = 16
"""One environment in this many is reset at once. Episodes of an untrained walker last about 20 steps."""

Info = dict[str, Array]
Step = tuple[Array, State, Array, Array, Info]


class EnvParams(flax.struct.PyTreeNode):
    """Parameters of gymnax's functions. They may be traced."""

    max_steps_in_episode: int
    """Time limit, steps."""


class Box(NamedTuple):
    """A space with the attributes and methods of `gymnax.environments.spaces.Box`."""

    low: float | np.ndarray
    """Lowest value: a number if it is the same for every element, as hashable networks need it."""
    high: float | np.ndarray
    """Highest value, likewise."""
    shape: tuple[int, ...]
    dtype: type = jnp.float32

    def sample(self, key: Array) -> Array:
        """Uniform sample of a bounded space, in its shape."""
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: ArrayLike) -> Array:
        """Whether all elements are within the bounds, `[] bool`."""
        return jnp.all((x >= jnp.asarray(self.low)) & (x <= jnp.asarray(self.high)))


class GymnaxEnv:
    """One unbatched environment, Gymnasium's task. Actions are in Gymnasium's units.

    `step` returns five values, `(obs, state, reward, done, info)`, as gymnax 0.0.9, rejax and PureJaxRL have them. It
    applies the time limit and resets a finished environment. gymnax itself is not needed.

    Source: gymnax's `Environment`. Deviation: under `vmap`, a step computes resets for finished environments only.
    gymnax computes one for every environment, which here includes a pass of the physics.
    """

    def __init__(self, env: str, physics: str = "auto", *, final_observation: bool = False, **options: object):
        """
        Args:
            env: name of the task.
            physics: engine.
            final_observation: whether `info` also holds the observation before the reset, `final_observation`.
                PureJaxRL keeps `info` of all steps in memory.
            options: Gymnasium's, and those of `TaskOptions`. `max_episode_steps` is the default time limit.

        Raises:
            UserError: an unknown name, engine or option, or an invalid value.
        """
        self._task = make_env(env, physics, **options)
        self._has_final_observation = final_observation

    @property
    def name(self) -> str:
        """Name of the task."""
        return self._task.options.name

    @property
    def default_params(self) -> EnvParams:
        """Parameters with the time limit of the task's options."""
        return EnvParams(max_steps_in_episode=self._task.options.max_episode_steps)

    @property
    def num_actions(self) -> int:
        """Size of an action."""
        return self._task.action_size

    def action_space(self, params: EnvParams | None = None) -> Box:
        """Range of the motors, in Gymnasium's units. A trainer clips or scales its actions to it."""
        low, high = map(_common_value, self._task.action_range())
        return Box(low, high, (self._task.action_size,))

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """Unbounded observations, `[observation_size] f32`."""
        return Box(-math.inf, math.inf, (self._task.observation_size,))

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: Array, params: EnvParams | None = None) -> tuple[Array, State]:
        """Start an episode at random.

        Returns:
            The observation, `[observation_size] f32`, and the state.
        """
        return self.reset_env(key, params)

    @functools.partial(jax.jit, static_argnums=0)
    def step(self, key: Array, state: State, action: Array, params: EnvParams | None = None) -> Step:
        """Step once, and reset if the episode ends.

        Args:
            key: for the reset, which is that of `reset(jax.random.split(key)[1])`.
            state: returned by `reset` or `step`.
            action: `[num_actions]`, in Gymnasium's units, or `[]` for a single motor. The motors clip it; the control
                cost uses the unclipped action.
            params: the time limit. Default: `default_params`.

        Returns:
            Observation and state, those of a new episode if `done`; the reward, `[] f32`; whether the episode ended,
            `[] bool`; and `info` of `step_env`, with `final_observation` if the environment was made with it.

        Raises:
            ValueError: the action has another shape.
        """
        key, reset_key = jax.random.split(key)
        obs, after, reward, done, info = self.step_env(key, state, action, params)
        if self._has_final_observation:
            info = info | {"final_observation": obs}
        after = batch_once(self._restart_finished)(done, reset_key, after)
        return after.obs, after, reward, done, info

    def reset_env(self, key: Array, params: EnvParams | None = None) -> tuple[Array, State]:
        """`reset`, not compiled."""
        state = self._task.reset(key)
        return state.obs, state

    def step_env(self, key: Array, state: State, action: Array, params: EnvParams | None = None) -> Step:
        """Step once, without a reset and not compiled. `key` is not used.

        Returns:
            As `step`, with the observation and the state that end the episode. `info` has `terminated` and
            `truncated`, `[] bool`, and `discount`, `[] f32`: zero if the task ended the episode, otherwise one.
        """
        if self._task.action_size == 1 and jnp.ndim(action) == 0:  # rejax squeezes actions
            action = jnp.reshape(action, (1,))
        limit = (params or self.default_params).max_steps_in_episode
        after = self._task.step(state, action)
        after = after.replace(truncated=after.steps >= limit)
        discount = 1.0 - jnp.float32(after.terminated)
        info = {"terminated": after.terminated, "truncated": after.truncated, "discount": discount}
        return after.obs, after, after.reward, after.terminated | after.truncated, info

    @standard_dtypes()
    def _restart_finished(self, done: Array, keys: Array, states: State) -> State:
        """Reset the finished environments of a batch, a block of them at a time.

        A reset costs a pass of the physics. `jax.lax.cond` would compute it for every environment under `vmap`.

        Args:
            done: `[N] bool`.
            keys: of the resets, `[N]` keys.
            states: `[N, …]`.
        """
        num_envs = len(done)
        block = math.ceil(num_envs / _ENVS_PER_RESET)
        finished = jnp.nonzero(done, size=block * math.ceil(num_envs / block), fill_value=num_envs)[0]

        def restart_block(carry: tuple[Array, State]) -> tuple[Array, State]:
            start, states = carry
            indices = jax.lax.dynamic_slice(finished, (start,), (block,))
            starts = jax.vmap(self._task.reset)(keys[jnp.minimum(indices, num_envs - 1)])
            states = jax.tree.map(lambda old, new: old.at[indices].set(new, mode="drop"), states, starts)
            return start + block, states

        num_done = done.sum(dtype=jnp.int32)
        return jax.lax.while_loop(lambda carry: carry[0] < num_done, restart_block, (jnp.int32(0), states))[1]


def _common_value(values: np.ndarray) -> float | np.ndarray:
    """The value of all elements, or the array if they differ."""
    return float(values[0]) if values.size and (values == values[0]).all() else values.astype(np.float32)
