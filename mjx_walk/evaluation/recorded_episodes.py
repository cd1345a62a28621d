"""Complete episodes of a policy in the real Gymnasium, with every observation, action and reward."""

import contextlib
import dataclasses
import os
from collections.abc import Generator, Iterator

import numpy as np
from jaxtyping import Bool, Float

from mjx_walk.envs import Task
from mjx_walk.evaluation.gymnasium_episodes import MAX_PARALLEL_EPISODES, ParallelEpisodes, Steps, warn_of_differences
from mjx_walk.evaluation.perturbations import Perturbation
from mjx_walk.logs.progress import ScoringProgress
from mjx_walk.utils.types import Act

__all__ = ["RecordedEpisode", "episodes_at_once", "record_episodes"]

_MAX_BYTES = 2**29
"""Memory that the episodes played at once may take."""
_NUM_INFOS = 16
"""Numbers in the `info` of a step; those of Gymnasium's tasks have at most as many."""


@dataclasses.dataclass(frozen=True)
class RecordedEpisode:
    """One episode of T steps."""

    seed: int | None
    """Seed of its reset in Gymnasium."""
    observations: Float[np.ndarray, "T+1 observation_size"]
    """In Gymnasium's order and units, f64, from the reset to the last step."""
    actions: Float[np.ndarray, "T action_size"]
    """f32, in Gymnasium's units."""
    rewards: Float[np.ndarray, " T"]
    """f64."""
    terminations: Bool[np.ndarray, " T"]
    truncations: Bool[np.ndarray, " T"]
    infos: dict[str, np.ndarray]
    """`[T+1, …] f64` each. The first row is NaN for entries that the reset's `info` does not have."""

    @property
    def num_bytes(self) -> int:
        """Size of its arrays."""
        flags = self.terminations.nbytes + self.truncations.nbytes
        numbers = (self.observations, self.actions, self.rewards, *self.infos.values())
        return flags + sum(array.nbytes for array in numbers)


def record_episodes(task: Task, act: Act, seeds: list[int]) -> Generator[RecordedEpisode, None, None]:
    """Play one episode per seed, without changes of the physics, and yield them in this order.

    As many as fit into half a gigabyte of memory are played side by side. Close the iterator to stop early.

    Args:
        task: an environment with an equivalent in Gymnasium, and its keywords.
        act: a JAX function `[N, observation_size] f32 → [N, action_size] f32`, both in Gymnasium's units.
        seeds: of the resets.

    Raises:
        UserError: the model file is gone.
    """
    warn_of_differences(task)
    size = episodes_at_once(task)
    rounds = [seeds[i : i + size] for i in range(0, len(seeds), size)]
    with contextlib.closing(ScoringProgress(len(seeds), len(rounds) * task.max_episode_steps, "recording")) as progress:
        for number, some in enumerate(rounds):
            yield from _play_round(task, act, some, progress, number * task.max_episode_steps, number * size)


def episodes_at_once(task: Task) -> int:
    """Number of episodes whose steps fit into memory; at least one for each core."""
    numbers = task.observation_size + task.action_size + _NUM_INFOS
    fitting = _MAX_BYTES // (8 * numbers * task.max_episode_steps)
    return min(max(fitting, os.cpu_count() or 1), MAX_PARALLEL_EPISODES)


def _play_round(
    task: Task, act: Act, seeds: list[int], progress: ScoringProgress, steps_before: int, num_before: int
) -> Iterator[RecordedEpisode]:
    """Play episodes side by side until all of them are over, then yield each of them."""
    lengths = np.zeros(len(seeds), np.int64)
    is_over = np.zeros(len(seeds), bool)
    actions: list[np.ndarray] = []
    with ParallelEpisodes(task, [(seed, Perturbation()) for seed in seeds], with_infos=True) as playing:
        steps = [playing.starts]
        while not is_over.all():
            lengths += ~is_over
            actions.append(np.asarray(act(steps[-1].obs.astype(np.float32))))
            steps.append(playing.step(actions[-1]))
            is_over = steps[-1].terminated | steps[-1].truncated
            progress.update(steps_before + int(lengths.max()), num_before + int(is_over.sum()))
    for i, (seed, length) in enumerate(zip(seeds, lengths, strict=True)):
        yield _cut_out(i, seed, steps[: length + 1], actions[:length])


def _cut_out(i: int, seed: int, steps: list[Steps], actions: list[np.ndarray]) -> RecordedEpisode:
    """Episode i of a round, from its reset to its last step."""
    starts = {name: np.full_like(values, np.nan) for name, values in steps[1].infos.items()} | steps[0].infos
    return RecordedEpisode(
        seed=seed,
        observations=np.stack([s.obs[i] for s in steps]),
        actions=np.stack([values[i] for values in actions]),
        rewards=np.array([s.rewards[i] for s in steps[1:]]),
        terminations=np.array([s.terminated[i] for s in steps[1:]]),
        truncations=np.array([s.truncated[i] for s in steps[1:]]),
        infos={name: np.stack([starts[name][i], *(s.infos[name][i] for s in steps[1:])]) for name in steps[1].infos},
    )
