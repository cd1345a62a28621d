"""Compiled resets and steps with Gymnasium's `info`, shared by all environments with the same options."""

import dataclasses
import functools
import os
from typing import TypeVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from mjx_walk.envs import TASKS, State, Task, TaskOptions
from mjx_walk.envs.info import Info
from mjx_walk.envs.physics import resolve_engine
from mjx_walk.machine.compat import prepare_jax

__all__ = ["Programs", "is_forked", "make_programs", "refuse_fork", "select_rows"]

_process_of_jax: list[int] = []
"""Id of the process in which this module first used JAX."""


class Programs:
    """The compiled functions of one task. `B` is the number of environments."""

    def __init__(self, task: Task):
        self.task = task
        self.reset_to = jax.jit(task.reset_to)
        self.step = jax.jit(task.step)
        self.reset_many = jax.jit(self._reset_many)
        self.step_many = jax.jit(self._step_many, static_argnames="mode")

    def reward(self, state: State) -> np.ndarray:
        """Sum of the reward terms, `[…] f64`. It is zero where the physics are not finite.

        The terms and `State.reward` are float32. Gymnasium's rewards equal the sum of their terms in float64.
        """
        terms = [np.asarray(state.metrics[name], np.float64) for name in self.task.reward_terms]
        offset = 0.0 if self.task.reward_hashes else self.task.REWARD_OFFSET
        return np.where(np.asarray(state.metrics["nonfinite"]) > 0, 0.0, sum(terms) + offset)

    def _reset_many(self, state: State | None, keys: jax.Array, mask: jax.Array) -> tuple[State, jax.Array, Info]:
        """Reset the environments of a mask, `[B] bool`. Each environment has its own key, `[B, 2] u32`."""
        new_keys, draws = _split_each(keys)
        new = jax.vmap(self.task.reset)(draws)
        if state is not None:
            new, new_keys = select_rows(mask, new, state), select_rows(mask, new_keys, keys)
        return new, new_keys, jax.vmap(self.task.reset_info)(new)

    def _step_many(
        self, state: State, actions: jax.Array, keys: jax.Array, was_over: jax.Array, mode: AutoresetMode
    ) -> tuple[State, State, jax.Array, Info, Info]:
        """Step all environments, and reset those that the mode says.

        Returns:
            The states after the resets and before them, the next keys, and the `info` of the step and of the resets.
        """
        last = jax.vmap(self.task.step)(state, actions)
        step_info = jax.vmap(self.task.step_info)(state, last)
        if mode == AutoresetMode.DISABLED:
            return last, last, keys, step_info, {}
        is_reset = was_over if mode == AutoresetMode.NEXT_STEP else last.terminated | last.truncated

        def reset_some(last: State, keys: jax.Array) -> tuple[State, jax.Array]:
            new, new_keys, _ = self._reset_many(last, keys, is_reset)
            return new, new_keys

        after, keys = jax.lax.cond(is_reset.any(), reset_some, lambda *unchanged: unchanged, last, keys)
        return after, last, keys, step_info, jax.vmap(self.task.reset_info)(after)


def make_programs(options: TaskOptions, physics: str) -> Programs:
    """The compiled functions for some options on an engine.

    Environments with equal options share them, so that many environments compile once. Files may change, so options
    that name a file are not shared.
    """
    prepare_jax()
    engine = resolve_engine(physics)
    if not _process_of_jax:
        _process_of_jax.append(os.getpid())
    if options.xml_file or options.reward_function:
        return _new_programs(options, engine)
    return _shared_programs(_Key(repr(options), engine, options))


def is_forked() -> bool:
    """Whether this process is a fork of one in which JAX has started. JAX then waits for threads that do not exist."""
    return bool(_process_of_jax) and _process_of_jax[0] != os.getpid()


def refuse_fork() -> None:
    """Raise an error in place of a deadlock.

    Raises:
        gymnasium.error.Error: the process is a fork.
    """
    if is_forked():
        raise gymnasium.error.Error(
            "JAX does not work in a forked process; use vector_kwargs={'context': 'spawn'}, or the default "
            "vectorization_mode, which steps all environments in one program"
        )


@dataclasses.dataclass(frozen=True)
class _Key:
    text: str
    engine: str
    options: TaskOptions = dataclasses.field(compare=False)


@functools.lru_cache(maxsize=64)
def _shared_programs(key: _Key) -> Programs:
    return _new_programs(key.options, key.engine)


def _new_programs(options: TaskOptions, engine: str) -> Programs:
    kind = TASKS[options.name][0]
    assert issubclass(kind, Task)  # Gymnasium's registry has no others
    return Programs(kind(options, engine, keep_info=True))


def _split_each(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Next keys and keys to draw with, `[B, 2] u32` each."""
    pairs = jax.vmap(jax.random.split)(keys)
    return pairs[:, 0], pairs[:, 1]


_Tree = TypeVar("_Tree")


def select_rows(mask: jax.Array, new: _Tree, old: _Tree) -> _Tree:
    """Rows of `new` where the mask is set, else of `old`, for all leaves `[B, …]`."""
    return jax.tree.map(lambda x, y: jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - 1)), x, y), new, old)
