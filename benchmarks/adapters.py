"""`python benchmarks/adapters.py`: speeds of the environments for other trainers."""

import argparse
import csv
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable

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
ADAPTERS = {"make_torch_env": "torch", "make_sb3_env": "stable_baselines3", "make_rsl_rl_env": "rsl_rl"}
"""Functions that make an environment, and the package that each needs."""
_STEPS_PER_POOL = 32
"""Steps after which training draws new random starts."""


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

    def step(self, actions: jax.Array) -> jax.Array:
        if self._count % _STEPS_PER_POOL == 0:
            self._state = self._renew(self._state, jax.random.PRNGKey(self._count))
        self._count += 1
        self._state, outcome = self._step(self._state, self._nobody, actions)
        return outcome.reward


def measure(env: str, num_envs: int, physics: str, seconds: float, rounds: int) -> dict[str, list[float]]:
    """Steps per second of each round, by the name of the environment."""
    task = mjx_walk.make_env(env, physics)
    low, high = np.asarray(task.action_low), np.asarray(task.action_high)
    actions = np.random.default_rng(0).uniform(low, high, (64, num_envs, task.action_size)).astype(np.float32)
    steps = {BARE: _stepper(Bare(task, num_envs).step, [jnp.asarray(some) for some in actions])}
    for name, package in ADAPTERS.items():
        if importlib.util.find_spec(package):
            steps[name] = _adapter(name, env, num_envs, physics, actions)
    speeds: dict[str, list[float]] = {name: [] for name in steps}
    for step in steps.values():
        _time(step, 0.0)
    for _ in range(rounds):
        for name, step in steps.items():
            count, duration = _time(step, seconds)
            speeds[name].append(count * num_envs / duration)
    return speeds


def _adapter(name: str, env: str, num_envs: int, physics: str, actions: np.ndarray) -> Callable[[int], None]:
    made = getattr(mjx_walk, name)(env, num_envs, physics=physics)
    if name != "make_rsl_rl_env":
        made.reset()
    if name == "make_sb3_env":
        return _stepper(made.step, list(actions))
    import torch

    return _stepper(made.step, [torch.from_numpy(some).to(made.device) for some in actions])


def _stepper(step: Callable, actions: list) -> Callable[[int], None]:
    """A function that makes some steps and waits for the last one's rewards."""

    def run(count: int) -> None:
        for i in range(count):
            result = step(actions[i % len(actions)])
        rewards = result[1] if isinstance(result, tuple) else result
        float(rewards.sum())

    return run


def _time(run: Callable[[int], None], seconds: float) -> tuple[int, float]:
    """Steps made in at least `seconds`, and how long they took."""
    count, start = 0, time.perf_counter()
    while True:
        run(16)
        count += 16
        duration = time.perf_counter() - start
        if duration >= seconds:
            return count, duration


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
