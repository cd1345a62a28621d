"""Circular replay buffer on the device. It stores each observation once, and returns true next observations."""

import dataclasses

import flax
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.common.returns import n_step_return
from mjx_walk.envs import BaseTask
from mjx_walk.machine.devices import num_bytes
from mjx_walk.utils.types import Transition

__all__ = ["Replay", "ReplayBuffer", "Steps"]

_GOES_ON, _TERMINATED, _FIRST_CUT = 0, 1, 2
"""Values of `Replay.end`; `_FIRST_CUT + i` is a truncation whose last observation lies in slot i."""


class Replay(flax.struct.PyTreeNode):
    """T rows of B environments in chronological order; row `rows % T` is written next.

    The observation after a step is in the next row, unless a time limit ended the episode. Those last observations have
    slots of their own after the rows. Two truncations of one environment are at least
    `max_episode_steps` apart, so a few slots per environment suffice, and a slot is free again when its turn comes.
    """

    observation: Array
    """`[T + slots, B, observation_size]`."""
    action: Array
    """`[T, B, action_size]`, in the networks' `[-1, 1]`."""
    reward: Array
    """`[T, B] f32`."""
    end: Array
    """`[T, B] i16`, i32 where there are so many slots: whether and how the step ended its episode."""
    cuts: Array
    """`[B] i32`: truncations so far."""
    rows: Array
    """`[] i32`: rows ever written."""


class Steps(flax.struct.PyTreeNode):
    """Consecutive steps of all environments, `[U, B, …]`."""

    observation: Array
    action: Array
    reward: Array
    terminated: Array
    truncated: Array
    next_observation: Array
    """The true one; read only where an episode was truncated."""


@dataclasses.dataclass(frozen=True)
class ReplayBuffer:
    """Functions on a `Replay` of one size."""

    task: BaseTask
    num_envs: int
    num_rows: int
    observation_dtype: str = "float32"

    @property
    def num_slots(self) -> int:
        """Slots for the last observations of truncated episodes, per environment."""
        return (self.num_rows - 1) // self.task.options.max_episode_steps + 1

    @property
    def num_transitions(self) -> int:
        """Capacity in transitions."""
        return self.num_rows * self.num_envs

    @property
    def num_bytes(self) -> int:
        """Bytes of a buffer, full or empty."""
        return num_bytes(jax.eval_shape(self.init))

    def init(self) -> Replay:
        """An empty buffer."""
        rows, envs = self.num_rows, self.num_envs
        return Replay(
            observation=jnp.zeros((rows + self.num_slots, envs, self.task.observation_size), self.observation_dtype),
            action=jnp.zeros((rows, envs, self.task.action_size), jnp.float32),
            reward=jnp.zeros((rows, envs), jnp.float32),
            end=jnp.zeros((rows, envs), jnp.int16 if _FIRST_CUT + self.num_slots < 2**15 else jnp.int32),
            cuts=jnp.zeros(envs, jnp.int32),
            rows=jnp.zeros((), jnp.int32),
        )

    def insert(self, replay: Replay, steps: Steps) -> Replay:
        """Write U rows over the oldest ones, at a cost that does not depend on how full the buffer is.

        Args:
            replay: consumed, if the caller's program donates it.
            steps: U of them, always the same number, which divides `num_rows`.
        """
        truncated = steps.truncated & ~steps.terminated
        earlier = jnp.cumsum(truncated, axis=0) - truncated
        slot = (replay.cuts + earlier) % self.num_slots
        end = jnp.where(truncated, _FIRST_CUT + slot, jnp.where(steps.terminated, _TERMINATED, _GOES_ON))
        start = replay.rows % self.num_rows

        def write(rows, new):
            return jax.lax.dynamic_update_slice_in_dim(rows, new.astype(rows.dtype), start, axis=0)

        def keep_cut(observation, step):
            is_cut, slot, last = step
            # Rows beyond the array's end are dropped.
            row = jnp.where(is_cut, self.num_rows + slot, observation.shape[0])
            env = jnp.arange(self.num_envs)
            return observation.at[row, env].set(last.astype(observation.dtype), mode="drop"), None

        observation = write(replay.observation, steps.observation)
        observation, _ = jax.lax.scan(keep_cut, observation, (truncated, slot, steps.next_observation))
        return Replay(
            observation=observation,
            action=write(replay.action, steps.action),
            reward=write(replay.reward, steps.reward),
            end=write(replay.end, end),
            cuts=replay.cuts + truncated.sum(axis=0),
            rows=replay.rows + steps.reward.shape[0],
        )

    def sample(
        self, replay: Replay, key: PRNGKeyArray, batch_size: int, n_step: int, discount: Float[Array, ""] | float
    ) -> Transition:
        """Draw transitions over up to `n_step` steps, uniformly and with replacement.

        Those that start in the newest `n_step` rows are left out: their next observation may not be written yet.

        Args:
            replay: with more than `n_step` rows written.
            key: random key.
            batch_size: N.
            n_step: n.
            discount: γ.

        Returns:
            `[N, …]`: `reward` is the discounted sum up to the episode's end or n steps; `discount` what the value of
            `next_observation` is to be multiplied by: 0 where the episode terminated on the way, else γ to the number
            of steps.
        """
        row_key, env_key = jax.random.split(key)
        written = jnp.minimum(replay.rows, self.num_rows)
        age = jax.random.randint(row_key, (batch_size,), 0, written - n_step)
        env = jax.random.randint(env_key, (batch_size,), 0, self.num_envs)
        first = replay.rows - written + age
        on_the_way = (first + jnp.arange(n_step)[:, None]) % self.num_rows
        ends = replay.end[on_the_way, env].astype(jnp.int32)
        reward, length = n_step_return(replay.reward[on_the_way, env], ends != _GOES_ON, discount)
        end = jnp.take_along_axis(ends, length[None] - 1, axis=0)[0]
        next_row = jnp.where(end >= _FIRST_CUT, self.num_rows + end - _FIRST_CUT, (first + length) % self.num_rows)
        first = first % self.num_rows
        return Transition(
            observation=replay.observation[first, env].astype(jnp.float32),
            action=replay.action[first, env],
            reward=reward,
            discount=jnp.where(end == _TERMINATED, 0.0, discount**length),
            next_observation=replay.observation[next_row, env].astype(jnp.float32),
            extras={"state_extras": {"truncation": jnp.zeros(batch_size)}},
        )
