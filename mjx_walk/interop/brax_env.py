"""A task as a `brax.envs.Env`, for Brax's wrappers and trainers and for algorithms written against them."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import base

from mjx_walk.envs import NO_TIME_LIMIT, make_env


class BraxEnv(base.Env):
    """One unbatched environment. It is Gymnasium's task, except that actions are Brax's: in [-1, 1] for every motor.

    It has no time limit of its own; Brax's `EpisodeWrapper` adds one, as for Brax's environments.
    """

    def __init__(self, env: str, physics: str = "auto", **keywords: Any):
        """
        Args:
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions` except the time limit.

        Raises:
            UserError: an unknown name, engine or keyword.
        """
        self._task = make_env(env, physics, **keywords | {"max_episode_steps": NO_TIME_LIMIT})

    def reset(self, rng: jax.Array) -> base.State:
        """Start an episode at random. `pipeline_state` holds this package's `State`."""
        state = self._task.reset(rng)
        return base.State(state, state.obs, state.reward, jnp.zeros(()), state.metrics)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """Step once. `done` means that the task ended the episode; the time limit never sets it."""
        after = self._task.step(state.pipeline_state, self._task.scale_action(action))
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
