"""Score a policy: in the real Gymnasium, or in a run's own engine."""

import dataclasses
import importlib.metadata
import json
import os
import platform
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np

import mjx_walk
from mjx_walk.envs import Task
from mjx_walk.rollout import evaluate
from mjx_walk.types import PolicyFn

_PACKAGES = ("gymnasium", "mujoco", "mujoco-mjx", "warp-lang", "jax", "brax", "numpy")


@dataclasses.dataclass
class Scores:
    """Undiscounted returns and lengths of whole episodes."""

    returns: np.ndarray
    """`[N] f64`."""
    lengths: np.ndarray
    """`[N] i64`."""
    seeds: list[int]
    env: str

    @property
    def mean(self) -> float:
        return float(self.returns.mean())

    @property
    def std(self) -> float:
        return float(self.returns.std())

    def __str__(self) -> str:
        return (
            f"{self.env}: {self.mean:,.1f} ± {self.std:,.1f} over {len(self.returns)} episodes, "
            f"mean length {self.lengths.mean():,.1f}, lowest {self.returns.min():,.1f}"
        )

    def save(self, path: Path, **facts: Any) -> None:
        """Write all episodes with the versions that made them, and any further facts, as JSON."""
        content = {
            "env": self.env,
            "mean": self.mean,
            "std": self.std,
            "returns": self.returns.tolist(),
            "lengths": self.lengths.tolist(),
            "seeds": self.seeds,
            "versions": versions(),
            **facts,
        }
        path.write_text(json.dumps(content, indent=1))


def versions() -> dict[str, str]:
    """Versions of this package and of all that a score depends on."""
    found = {"mjx_walk": mjx_walk.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def score_in_gymnasium(
    task: Task, act: Callable[[np.ndarray], np.ndarray], num_episodes: int, seed: int = 0
) -> Scores:
    """Whole episodes in `gymnasium.make`: CPU MuJoCo, float64, the model's own solver.

    The episodes run side by side, one environment each, stepped by one thread a core.

    Args:
        task: says which environment, with which keywords.
        act: `[N, observation_size] f32 → [N, action_size] f32`, both in Gymnasium's units.
        num_episodes: N.
        seed: episode i is reset with `seed + i`.
    """
    kwargs = task.gymnasium_kwargs() | {"max_episode_steps": task.options.max_episode_steps}
    envs = [gymnasium.make(task.gymnasium_id, **kwargs) for _ in range(num_episodes)]
    seeds = [seed + i for i in range(num_episodes)]
    returns, lengths = np.zeros(num_episodes), np.zeros(num_episodes, np.int64)
    obs = np.stack([env.reset(seed=s)[0] for env, s in zip(envs, seeds, strict=True)]).astype(np.float32)
    running = np.arange(num_episodes)

    def step(i: int, action: np.ndarray) -> bool:
        obs[i], reward, terminated, truncated, _ = envs[i].step(action)
        returns[i] += reward
        lengths[i] += 1
        return terminated or truncated

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        num_shares = os.cpu_count() or 1
        while running.size:
            actions = np.asarray(act(obs))

            def step_share(share: np.ndarray, actions: np.ndarray = actions) -> list[bool]:
                return [step(i, actions[i]) for i in share]

            ended = np.concatenate(list(pool.map(step_share, np.array_split(running, num_shares)))).astype(bool)
            running = running[~ended]
    for env in envs:
        env.close()
    return Scores(returns, lengths, seeds, task.gymnasium_id)


def score_in_sim(task: Task, policy: PolicyFn, num_episodes: int, seed: int = 0) -> Scores:
    """Whole episodes in the task's own engine, all side by side."""
    returns, lengths = jax.jit(lambda key: evaluate(task, num_episodes, policy, key))(jax.random.PRNGKey(seed))
    name = f"{task.gymnasium_id} on {task.engine.name}"
    return Scores(np.asarray(returns, np.float64), np.asarray(lengths, np.int64), [seed], name)
