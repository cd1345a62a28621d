"""A task as a `brax.envs.Env`, for code written for Brax: its wrappers, its trainers, its own algorithms."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import base

from mjx_walk.common.networks import to_env_action
from mjx_walk.envs import NO_TIME_LIMIT, make_env


class BraxEnv(base.Env):
    """One unbatched copy. Actions are Brax's, in [-1, 1] whatever the motors' range; the rest is Gymnasium's task.

    The time limit is that of Brax's `EpisodeWrapper`, as for its own environments.
    """

    def __init__(self, env: str, physics: str = "auto", **keywords: Any):
        """
        Args:
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions` but for the time limit.

        Raises:
            UserError: an unknown name, engine or keyword.
        """
        self._task = make_env(env, physics, **keywords | {"max_episode_steps": NO_TIME_LIMIT})

    def reset(self, rng: jax.Array) -> base.State:
        """A random start; `pipeline_state` is this package's own `State`."""
        state = self._task.reset(rng)
        return base.State(state, state.obs, state.reward, jnp.zeros(()), state.metrics)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """One step; `done` is a fall, never the time limit."""
        after = self._task.step(state.pipeline_state, to_env_action(self._task, action))
        return state.replace(
            pipeline_state=after,
            obs=after.obs,
            reward=after.reward,
            done=jnp.float32(after.terminated),
            metrics=state.metrics | after.metrics,
        )

    @property
    def observation_size(self) -> int:
        return self._task.observation_size

    @property
    def action_size(self) -> int:
        return self._task.action_size

    @property
    def backend(self) -> str:
        return self._task.engine.name
