"""Scores of a policy: in the real Gymnasium, or in a run's own engine."""

import contextlib
import dataclasses
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Float, Int

from mjx_walk.common.rollout import evaluate
from mjx_walk.envs import BaseTask, Task, require_model
from mjx_walk.envs.randomization.options import Randomization
from mjx_walk.evaluation.gymnasium_episodes import MAX_PARALLEL_EPISODES, ParallelEpisodes, warn_of_differences
from mjx_walk.evaluation.perturbations import Perturbation
from mjx_walk.logs.progress import ScoringProgress
from mjx_walk.machine.signals import undisturbed
from mjx_walk.storage.scores import Scores
from mjx_walk.utils.setting_fields import MAX_SEED, setting
from mjx_walk.utils.types import Act, PolicyFn

__all__ = ["Episodes", "ScoreRequest", "compile_episodes", "play_in_gymnasium", "score_in_gymnasium", "score_in_sim"]


@dataclasses.dataclass
class ScoreRequest:
    """Policy, task and episodes that a user asks to be scored."""

    episodes: int = setting(100, at_least=1)
    backend: str = setting("gymnasium", choices=("gymnasium", "sim"))
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)


Episodes = Callable[[jax.Array, int], tuple[jax.Array, jax.Array, dict[str, jax.Array]]]
"""`key, N → returns [N] f32, lengths [N] i32, means of the task's measures [N] f32`."""


def score_in_gymnasium(task: BaseTask, act: Act, num_episodes: int, seed: int = 0) -> Scores:
    """Score complete episodes in `gymnasium.make`: MuJoCo on the CPU, in float64, with the model's own solver.

    One process per core plays the episodes. A task without an equivalent in Gymnasium is scored in its own engine,
    with its original physics.

    Args:
        task: the environment and its keywords.
        act: a JAX function `[N, observation_size] f32 → [N, action_size] f32`, both in Gymnasium's units.
        num_episodes: N.
        seed: episode i is reset with `seed + i`. Seeds that differ by fewer than N share episodes.

    Raises:
        UserError: the model file is gone.
    """
    if not task.is_in_gymnasium:
        if isinstance(task, Task) and task.randomizer.is_on:
            task = type(task)(dataclasses.replace(task.options, randomize=Randomization()), task.engine.name)
        return score_in_sim(task, compile_episodes(task, lambda obs, key: act(obs)), num_episodes, seed)
    seeds = [int(seed) + i for i in range(num_episodes)]  # Gymnasium refuses NumPy's integers
    returns, lengths = play_in_gymnasium(require_model(task), act, seeds)
    return Scores(returns, lengths, seeds, task.gymnasium_id)


def play_in_gymnasium(
    task: Task, act: Act, seeds: list[int], changes: list[Perturbation] | None = None
) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Play one episode per seed; their returns and lengths.

    Args:
        task: an environment with an equivalent in Gymnasium, and its keywords.
        act: as for `score_in_gymnasium`.
        seeds: of the resets, N.
        changes: changed physics of each episode, N; by default none.

    Raises:
        UserError: the model file is gone.
    """
    warn_of_differences(task)
    episodes = list(zip(seeds, changes or [Perturbation()] * len(seeds), strict=True))
    rounds = [episodes[i : i + MAX_PARALLEL_EPISODES] for i in range(0, len(episodes), MAX_PARALLEL_EPISODES)]
    with contextlib.closing(ScoringProgress(len(episodes), len(rounds) * task.max_episode_steps)) as progress:
        played = [_play_round(task, act, some, progress, number) for number, some in enumerate(rounds)]
    returns, lengths = zip(*played, strict=True)
    return np.concatenate(returns), np.concatenate(lengths)


def _play_round(
    task: Task, act: Act, episodes: list[tuple[int, Perturbation]], progress: ScoringProgress, rounds_before: int
) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Play episodes in parallel, each with its seed and its changes; their returns and lengths."""
    steps_before = rounds_before * task.max_episode_steps
    num_before = rounds_before * MAX_PARALLEL_EPISODES
    returns, lengths = np.zeros(len(episodes)), np.zeros(len(episodes), np.int64)
    is_over = np.zeros(len(episodes), bool)
    with ParallelEpisodes(task, episodes) as playing:
        obs = playing.starts.obs
        while not is_over.all():
            lengths += ~is_over
            steps = playing.step(np.asarray(act(obs.astype(np.float32))))
            obs, is_over = steps.obs, steps.terminated | steps.truncated
            returns += steps.rewards
            progress.update(steps_before + int(lengths.max()), num_before + int(is_over.sum()))
    return returns, lengths


def compile_episodes(task: BaseTask, policy: PolicyFn) -> Episodes:
    """Compile complete episodes in the task's own engine, once for each number of episodes."""
    return jax.jit(lambda key, num_episodes: evaluate(task, num_episodes, policy, key), static_argnums=1)


def score_in_sim(task: BaseTask, episodes: Episodes, num_episodes: int, seed: int = 0) -> Scores:
    """Score complete episodes in the task's own engine, all in one batch.

    Args:
        task: the environment.
        episodes: see `compile_episodes`.
        num_episodes: N.
        seed: of the starts.
    """
    with undisturbed("finishing the episodes"):
        found = jax.block_until_ready(episodes(jax.random.PRNGKey(seed), num_episodes))
    returns, lengths, measures = jax.tree.map(np.asarray, found)
    on_hills = isinstance(task, Task) and task.ground.is_on
    name = f"{task.gymnasium_id} on {task.engine.name}" + (", on hills" if on_hills else "")
    if measures and task.terminates_on_fall:
        measures["falls (%)"] = 100 * (lengths < task.max_episode_steps)
    means = {measure: np.asarray(values, np.float64) for measure, values in measures.items()}
    return Scores(np.asarray(returns, np.float64), np.asarray(lengths, np.int64), [seed], name, means)
