"""One environment of the vector environment, for code that asks for its attributes."""

from typing import TYPE_CHECKING

import gymnasium
import jax
import numpy as np
from gymnasium.envs.registration import EnvSpec

from mjx_walk.envs import State
from mjx_walk.envs.state import in_same_episode
from mjx_walk.interop.mujoco_attributes import MujocoAttributes

if TYPE_CHECKING:
    from mjx_walk.interop.gymnasium_vector_env import MjxWalkVectorEnv

__all__ = ["SubEnv"]


class SubEnv(MujocoAttributes):
    """One environment of `MjxWalkVectorEnv`, as `get_attr`, `set_attr`, `call` and `render` see it."""

    def __init__(self, vector_env: "MjxWalkVectorEnv", index: int):
        self._vector_env, self._index = vector_env, index

    @property
    def _gymnasium_env(self):  # type: ignore[override]
        return self._vector_env._gymnasium_env

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

    def _write_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        env, i = self._vector_env, self._index
        if env._state is None:
            raise gymnasium.error.ResetNeeded("call reset before set_state")
        old = jax.tree.map(lambda x: x[i], env._state)
        # As in Gymnasium, activations stay.
        new, _ = env._programs.reset_to(qpos, qvel, old.physics.qacc_warmstart, old.physics.act)
        new = in_same_episode(old, new).replace(steps=old.steps)
        env._state = jax.tree.map(lambda x, y: x.at[i].set(y), env._state, new)
