"""`python benchmarks/adapters.py`: speeds of the environments for other trainers."""

import argparse
import csv
import functools
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mjx_walk
from mjx_walk.envs import Task
from mjx_walk.envs.vector_env import VectorEnv

__all__ = ["ADAPTERS", "BARE", "measure"]

_DESCRIPTION = """
Step environments as training does, and through each adapter whose package is installed, with the same random actions.
Print CSV: steps per second, and their ratio to training's speed in the same round. Both are medians over rounds.
"""
BARE = "training's environment"
_STEPS_PER_POOL = 32
"""Steps after which training draws new random starts."""
_STEPS_PER_WAIT = 16


class Bare:
    """The environment as training steps it."""

    def __init__(self, task: Task, num_envs: int):
        self._env = VectorEnv(task, num_envs)
        self._state = jax.jit(self._env.init)(jax.random.PRNGKey(0))
        self._nobody = jax.tree.map(lambda x: x[:0], self._state.env)
        self._step = jax.jit(self._one_step, donate_argnums=0)
        self._renew = jax.jit(self._env.renew_pool, donate_argnums=0)
        self._count = 0

    def _one_step(self, state, nobody, actions):
        state, _, outcome, _ = self._env.step(state, actions, nobody, actions[:0])
        return state, outcome

    def prepared(self, actions: np.ndarray) -> list[jax.Array]:
        return [jnp.asarray(some) for some in actions]

    def step(self, actions: jax.Array) -> jax.Array:
        if self._count % _STEPS_PER_POOL == 0:
            self._state = self._renew(self._state, jax.random.PRNGKey(self._count))
        self._count += 1
        self._state, outcome = self._step(self._state, self._nobody, actions)
        return outcome.reward


class Adapter:
    """An environment for another trainer, with actions as that trainer has them."""

    def __init__(self, env: Any, to_actions: Callable[[np.ndarray], Any]):
        self._env, self._to_actions = env, to_actions

    def prepared(self, actions: np.ndarray) -> list[Any]:
        return [self._to_actions(some) for some in actions]

    def step(self, actions: Any) -> Any:
        return self._env.step(actions)[1]


def _torch(env: str, num_envs: int, physics: str) -> Adapter:
    import torch

    made = mjx_walk.make_torch_env(env, num_envs, physics=physics)
    made.reset(seed=0)
    return Adapter(made, functools.partial(torch.tensor, device=made.device))


def _rsl_rl(env: str, num_envs: int, physics: str) -> Adapter:
    import torch

    made = mjx_walk.make_rsl_rl_env(env, num_envs, physics=physics, seed=0)
    return Adapter(made, functools.partial(torch.tensor, device=made.device))


def _sb3(env: str, num_envs: int, physics: str) -> Adapter:
    made = mjx_walk.make_sb3_env(env, num_envs, physics=physics)
    made.reset()
    return Adapter(made, np.array)


ADAPTERS = {
    "PyTorch": ("torch", _torch),
    "rsl_rl": ("rsl_rl", _rsl_rl),
    "Stable-Baselines3": ("stable_baselines3", _sb3),
}
"""For each adapter, the package that it needs and a function that makes it."""


def measure(env: str, num_envs: int, physics: str, seconds: float, rounds: int) -> dict[str, list[float]]:
    """Steps per second of each round, by the name of the environment."""
    task = mjx_walk.make_env(env, physics)
    low, high = np.asarray(task.action_low), np.asarray(task.action_high)
    actions = np.random.default_rng(0).uniform(low, high, (64, num_envs, task.action_size)).astype(np.float32)
    envs: dict[str, Bare | Adapter] = {BARE: Bare(task, num_envs)}
    for name, (package, make) in ADAPTERS.items():
        if importlib.util.find_spec(package):
            envs[name] = make(env, num_envs, physics)
    given = {name: one.prepared(actions) for name, one in envs.items()}
    speeds: dict[str, list[float]] = {name: [] for name in envs}
    for name, one in envs.items():
        _speed(one, given[name], 0.0)
    for _ in range(rounds):
        for name, one in envs.items():
            speeds[name].append(num_envs * _speed(one, given[name], seconds))
    return speeds


def _speed(env: Bare | Adapter, actions: list[Any], seconds: float) -> float:
    """Steps per second over at least that long, until the last rewards are there."""
    count, start = 0, time.perf_counter()
    while True:
        for _ in range(_STEPS_PER_WAIT):
            rewards = env.step(actions[count % len(actions)])
            count += 1
        float(rewards.sum())
        duration = time.perf_counter() - start
        if duration >= seconds:
            return count / duration


def main() -> None:
    parser = argparse.ArgumentParser("python benchmarks/adapters.py", description=_DESCRIPTION)
    parser.add_argument("--env", default="humanoid")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--physics", default="auto")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each environment in a round")
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    speeds = measure(given.env, given.num_envs, given.physics, given.seconds, given.rounds)
    rows = csv.writer(sys.stdout)
    rows.writerow(("Environment", "Steps/s", "Ratio"))
    for name, measured in speeds.items():
        ratios = [one / bare for one, bare in zip(measured, speeds[BARE], strict=True)]
        rows.writerow((name, round(statistics.median(measured)), f"{statistics.median(ratios):.3f}"))


if __name__ == "__main__":
    main()
