"""Complete episodes of a policy in the task's own engine, with every observation, action and reward."""

import contextlib
import functools
from collections.abc import Callable, Generator
from typing import NamedTuple

import jax
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from mjx_walk.envs import State, Task
from mjx_walk.evaluation.recorded_episodes import RecordedEpisode, episodes_at_once
from mjx_walk.logs.progress import ScoringProgress
from mjx_walk.machine.signals import undisturbed
from mjx_walk.utils.types import PolicyFn

__all__ = ["simulate_episodes"]

_CHUNK = 100
"""Steps of one call. Between calls, the host looks which episodes are over."""


class _Step(NamedTuple):
    """What is kept of a step, `[N, …]`; stacked over time, `[T, N, …]`."""

    obs: Array
    """After the step."""
    action: Array
    reward: Array
    terminated: Array
    truncated: Array
    terms: dict[str, Array]
    """Of the reward."""


def simulate_episodes(
    task: Task, policy: PolicyFn, num_episodes: int, seed: int
) -> Generator[RecordedEpisode, None, None]:
    """Play episodes and yield them in order. They start as those of `eval backend=sim` with the same number and seed.

    As many as fit into half a gigabyte of memory are played in one batch. Close the iterator to stop early.

    Args:
        task: the environment.
        policy: a deterministic one.
        num_episodes: N.
        seed: of the starts.
    """
    reset_key, _ = jax.random.split(jax.random.PRNGKey(seed))
    keys = jax.random.split(reset_key, num_episodes)
    size = min(episodes_at_once(task), num_episodes)
    reset = jax.jit(jax.vmap(task.reset))
    play = jax.jit(functools.partial(_play_chunk, task, policy))
    num_rounds = -(-num_episodes // size)
    max_steps = num_rounds * task.max_episode_steps
    with contextlib.closing(ScoringProgress(num_episodes, max_steps, "recording")) as progress:
        for number, first in enumerate(range(0, num_episodes, size)):
            # The last batch repeats episodes before it: another size would compile again.
            start = min(first, num_episodes - size)
            batch = reset(keys[start : start + size])
            report = functools.partial(_report, progress, number * task.max_episode_steps, start)
            steps, lengths = _play_batch(batch, play, report)
            for i in range(first - start, size):
                yield _cut_out(np.asarray(batch.obs[i]), steps, i, int(lengths[i]))


def _report(progress: ScoringProgress, steps_before: int, num_before: int, steps: int, num_over: int) -> None:
    progress.update(steps_before + steps, num_before + num_over)


def _play_batch(
    state: State, play: Callable[[State], tuple[State, _Step]], report: Callable[[int, int], None]
) -> tuple[_Step, Int[np.ndarray, " N"]]:
    """Play N episodes until all of them are over: their steps, and their lengths."""
    chunks: list[_Step] = []
    over = np.zeros((0, len(state.obs)), bool)
    while not over.any(0).all():
        with undisturbed("finishing the present steps"):
            state, steps = play(state)
            chunks.append(jax.tree.map(np.asarray, steps))
        over = np.concatenate((over, chunks[-1].terminated | chunks[-1].truncated))
        report(len(over), int(over.any(0).sum()))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *chunks), over.argmax(0) + 1


def _cut_out(start: Float[np.ndarray, " observation_size"], steps: _Step, i: int, length: int) -> RecordedEpisode:
    """Episode i of a batch, from its reset to its last step."""
    obs, action, reward, terminated, truncated, terms = jax.tree.map(lambda values: values[:length, i], steps)
    return RecordedEpisode(
        seed=None,
        observations=np.concatenate((start[None], obs)).astype(np.float64),
        actions=action,
        rewards=reward.astype(np.float64),
        terminations=terminated,
        truncations=truncated,
        infos={name: np.concatenate(([np.nan], values)).astype(np.float64) for name, values in terms.items()},
    )


def _play_chunk(task: Task, policy: PolicyFn, state: State) -> tuple[State, _Step]:
    """The next steps of all environments. Those of episodes that are over are meaningless."""

    def one(state: State, _: None) -> tuple[State, _Step]:
        action = policy(state.obs, jax.random.PRNGKey(0))
        state = jax.vmap(task.step)(state, action)
        terms = {name: state.metrics[name] for name in task.reward_terms}
        return state, _Step(state.obs, action, state.reward, state.terminated, state.truncated, terms)

    return jax.lax.scan(one, state, length=min(_CHUNK, task.max_episode_steps))
