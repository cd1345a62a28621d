"""Many environments in two compiled programs, for trainers that are not written in JAX."""

from typing import NamedTuple

import flax
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from mjx_walk.envs import State, Task
from mjx_walk.interop.gymnasium_programs import select_rows
from mjx_walk.machine.devices import default_device
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import MAX_SEED
from mjx_walk.utils.value_types import type_problem

__all__ = ["BatchState", "EnvBatch", "Step"]


class BatchState(flax.struct.PyTreeNode):
    """The environments, random starts for those whose episode ends, and sums over the episodes."""

    env: State
    """`[B, …]`."""
    starts: State
    """`[B, …]` random resets."""
    starts_used: Int[Array, ""]
    """Starts taken since they were drawn."""
    returns: Float[Array, " B"]
    """Sums of the rewards of the episodes so far."""
    key: PRNGKeyArray


class Step(NamedTuple):
    """Result of a step. Finished environments are already reset, as in Gymnasium's `AutoresetMode.SAME_STEP`."""

    obs: Float[Array, "B observation_size"]
    """After the resets."""
    final_obs: Float[Array, "B observation_size"]
    """Before the resets."""
    reward: Float[Array, " B"]
    terminated: Bool[Array, " B"]
    truncated: Bool[Array, " B"]
    returns: Float[Array, " B"]
    """Sums of the rewards of the episodes, up to this step."""
    lengths: Int[Array, " B"]
    """Steps of the episodes, up to this one."""


class EnvBatch:
    """`num_envs` environments, B, that step in one program."""

    def __init__(self, task: Task, num_envs: int):
        """
        Raises:
            UserError: `num_envs` is not a positive integer.
        """
        if type_problem(num_envs, int) or num_envs < 1:
            raise UserError(f"num_envs={num_envs}: must be an integer of at least 1")
        self.task, self.num_envs = task, num_envs
        self.init = jax.jit(self._init)
        self.step = jax.jit(self._step, donate_argnums=0)

    def observation_space(self, dtype: str) -> gymnasium.spaces.Box:
        """Space of the observations of one environment, as Gymnasium has it with `float64`."""
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.task.observation_size,), np.dtype(dtype))

    def action_space(self) -> gymnasium.spaces.Box:
        """Space of the actions of one environment, as Gymnasium has it."""
        return gymnasium.spaces.Box(np.array(self.task.action_low), np.array(self.task.action_high), dtype=np.float32)

    def reset(
        self, state: BatchState | None, seed: int | None = None
    ) -> tuple[BatchState, Float[Array, "B observation_size"]]:
        """Start an episode in each environment.

        Args:
            state: whose random numbers continue, unless a seed is given. None: a seed is drawn.
            seed: an integer from 0 to 2³² - 1.

        Returns:
            The state and the observations.

        Raises:
            UserError: the seed is not such an integer.
        """
        if state is not None and seed is None:
            return self.init(state.key)
        seed = int(np.random.default_rng().integers(2**31)) if seed is None else seed
        if type_problem(seed, int) or not 0 <= seed <= MAX_SEED:
            raise UserError(f"seed={seed}: must be an integer from 0 to {MAX_SEED}")
        # On a device by name, as actions from other libraries are. Otherwise the second step compiles again.
        return self.init(jax.device_put(jax.random.PRNGKey(seed), default_device()))

    def _init(self, key: PRNGKeyArray) -> tuple[BatchState, Float[Array, "B observation_size"]]:
        env_key, starts_key, key = jax.random.split(key, 3)
        env = self._reset_all(env_key)
        state = BatchState(
            env=env,
            starts=self._reset_all(starts_key),
            starts_used=jnp.zeros((), jnp.int32),
            returns=jnp.zeros(self.num_envs, jnp.float32),
            key=key,
        )
        return state, env.obs

    def _step(self, state: BatchState, actions: Float[Array, "B action_size"]) -> tuple[BatchState, Step]:
        """Step all environments, and start new episodes where they end. No two episodes have the same start.

        Args:
            state: its memory is reused, so it cannot be read after the call.
            actions: in Gymnasium's units.
        """
        env = jax.vmap(self.task.step)(state.env, actions)
        done = env.terminated | env.truncated
        num_done = done.sum(dtype=jnp.int32)
        # A reset takes a forward pass of the physics. So starts are drawn for all environments, when none are left.
        state = jax.lax.cond(state.starts_used + num_done > self.num_envs, self._with_new_starts, _unchanged, state)
        start = jnp.clip(state.starts_used + jnp.cumsum(done) - 1, 0, self.num_envs - 1)
        after = select_rows(done, jax.tree.map(lambda x: x[start], state.starts), env)
        returns = state.returns + env.reward
        state = state.replace(
            env=after, starts_used=state.starts_used + num_done, returns=jnp.where(done, 0.0, returns)
        )
        return state, Step(after.obs, env.obs, env.reward, env.terminated, env.truncated, returns, env.steps)

    def _with_new_starts(self, state: BatchState) -> BatchState:
        key, starts_key = jax.random.split(state.key)
        return state.replace(starts=self._reset_all(starts_key), starts_used=jnp.zeros((), jnp.int32), key=key)

    def _reset_all(self, key: PRNGKeyArray) -> State:
        return jax.vmap(self.task.reset)(jax.random.split(key, self.num_envs))


def _unchanged(state: BatchState) -> BatchState:
    return state
