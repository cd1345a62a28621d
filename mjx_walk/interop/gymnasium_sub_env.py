"""One environment of the vector environment, for code that asks for its attributes."""

from typing import TYPE_CHECKING

import gymnasium
import jax
import numpy as np
from gymnasium.envs.registration import EnvSpec

from mjx_walk.envs import State
from mjx_walk.envs.state import in_same_episode
from mjx_walk.interop.live_data import Moment
from mjx_walk.interop.mujoco_attributes import MujocoAttributes

if TYPE_CHECKING:
    from mjx_walk.interop.gymnasium_vector_env import MjxWalkVectorEnv

__all__ = ["SubEnv"]


class SubEnv(MujocoAttributes):
    """One environment of `MjxWalkVectorEnv`, as `get_attr`, `set_attr`, `call` and `render` see it."""

    def __init__(self, vector_env: "MjxWalkVectorEnv", index: int):
        self._vector_env, self._index = vector_env, index
        self._moment = Moment()
        self._seen: State | None = None  # the vector environment's state to which the moment belongs

    @property
    def _gymnasium_env(self):  # type: ignore[override]
        return self._vector_env._gymnasium_env

    @property
    def _snapshot(self):  # type: ignore[override]
        return self._vector_env._snapshot

    @property
    def _read_data(self):  # type: ignore[override]
        return self._vector_env._read_data

    @property
    def _task(self):  # type: ignore[override]
        return self._vector_env._programs.task

    @property
    def render_mode(self) -> str | None:  # type: ignore[override]
        return self._vector_env.render_mode

    @property
    def metadata(self) -> dict[str, object]:
        """Gymnasium's for one environment."""
        return {name: value for name, value in self._vector_env.metadata.items() if name != "autoreset_mode"}

    @property
    def spec(self) -> EnvSpec | None:
        return self._vector_env.spec

    @property
    def observation_space(self) -> gymnasium.Space:
        return self._vector_env.single_observation_space

    @property
    def action_space(self) -> gymnasium.Space:
        return self._vector_env.single_action_space

    @property
    def np_random_seed(self) -> int:
        return self._vector_env.np_random_seed[self._index]

    # No wrapper is around one environment.
    unwrapped = gymnasium.Env.unwrapped
    get_wrapper_attr = gymnasium.Env.get_wrapper_attr
    has_wrapper_attr = gymnasium.Env.has_wrapper_attr
    set_wrapper_attr = gymnasium.Env.set_wrapper_attr

    def _read_state(self) -> State | None:
        return jax.tree.map(lambda x: x[self._index], self._vector_env._state)

    def _read_moment(self) -> Moment:
        env, i = self._vector_env, self._index
        if env._state is not None and env._state is not self._seen:
            state, step = jax.device_get(jax.tree.map(lambda x: x[i], (env._state, env._last_step)))
            # The physics of a finite step has moved; otherwise it is that of a reset, or as it was.
            has_moved = step is not None and state.steps > 0 and not state.metrics["nonfinite"]
            moment = Moment(state.physics, *step) if has_moved else Moment(state.physics)
            self._moment = moment._replace(placed=env._placed.get(i))
            self._seen = env._state
        return self._moment

    def _write_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        env, i = self._vector_env, self._index
        if env._state is None:
            raise gymnasium.error.ResetNeeded("call reset before set_state")
        env._refuse_changed_data()
        old = jax.tree.map(lambda x: x[i], env._state)
        # As in Gymnasium, activations stay.
        new = env._programs.reset_to(np.float32(qpos), np.float32(qvel), old.physics.qacc_warmstart, old.physics.act)
        new = in_same_episode(old, new)
        env._state = jax.tree.map(lambda x, y: x.at[i].set(y), env._state, new)
        env._placed[i] = (qpos, qvel)
