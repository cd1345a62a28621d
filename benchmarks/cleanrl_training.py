"""`python benchmarks/cleanrl_training.py SCRIPT --env humanoid --out DIR`: returns of CleanRL's PPO on EnvPool."""

import argparse
import contextlib
import functools
import runpy
import sys
import time
from pathlib import Path
from typing import Any
from unittest import mock

import envpool
import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import vector as wrappers
from peer_returns import KeptPolicy, write_returns

from mjx_walk.envs import BUILT_IN_TASKS, make_env

__all__ = ["Pool", "TimeIsOver", "make_vector_env"]

_DESCRIPTION = """
Run CleanRL's ppo_continuous_action.py as it is, on EnvPool's environments instead of Gymnasium's, normalized and
clipped as in that file. Policies are kept on the way. At the end, score them on the episodes of
`python -m mjx_walk.eval` and write DIR/returns.csv.
"""
_BOUND = 10.0
"""Of normalized observations and rewards, as in CleanRL's file."""
_EPSILON = 1e-8
_DISCOUNT = 0.99


class TimeIsOver(Exception):
    """The training has had its seconds."""


class Pool(gymnasium.vector.VectorEnv):
    """EnvPool's environments as Gymnasium's vector environment, which keeps the policies that act in it.

    Args:
        env_id: of Gymnasium, such as `Humanoid-v5`.
        num_envs: environments.
        seed: of their resets.
        every: steps between two kept policies.
        seconds: until `step` raises `TimeIsOver`.
    """

    def __init__(self, env_id: str, num_envs: int, seed: int, every: int, seconds: float):
        self._pool: Any = envpool.make_gymnasium(env_id, num_envs=num_envs, seed=seed)
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space = self._pool.observation_space
        self.single_action_space = self._pool.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.kept: list[KeptPolicy] = []
        self.observation_statistics: Any = None
        """Gymnasium's running mean and variance, once the observations are normalized."""
        self._steps = 0
        self._every, self._seconds = every, seconds
        self._started = time.monotonic()

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        obs, _ = self._pool.reset()
        return obs, {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        obs, rewards, terminated, truncated, _ = self._pool.step(np.asarray(actions, self.single_action_space.dtype))
        before, self._steps = self._steps, self._steps + self.num_envs
        is_over = time.monotonic() - self._started > self._seconds
        if before // self._every < self._steps // self._every or is_over:
            self.keep(sys.modules["__main__"].agent)
        if is_over:
            raise TimeIsOver
        return obs, rewards, terminated, truncated, {}

    def keep(self, agent: Any) -> None:
        """Keep CleanRL's `Agent` as it is now, in place of one of the same step."""
        if self.kept and self.kept[-1].steps == self._steps:
            self.kept.pop()
        weights = [(x.weight.cpu().clone(), x.bias.cpu().clone()) for x in agent.actor_mean if hasattr(x, "weight")]
        mean, variance = (np.array(x) for x in (self.observation_statistics.mean, self.observation_statistics.var))
        bounds = (self._pool.action_space.low, self._pool.action_space.high)
        act = functools.partial(_act, weights, mean, np.sqrt(variance + _EPSILON), bounds)
        self.kept.append(KeptPolicy(self._steps, time.monotonic() - self._started, act))


@torch.no_grad()
def _act(
    weights: list[tuple[torch.Tensor, torch.Tensor]],
    mean: np.ndarray,
    std: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    obs: np.ndarray,
) -> np.ndarray:
    """The mean of CleanRL's policy, whose hidden layers are tanh."""
    x = torch.as_tensor(np.clip((np.asarray(obs) - mean) / std, -_BOUND, _BOUND), dtype=torch.float32)
    for i, (weight, bias) in enumerate(weights):
        x = torch.nn.functional.linear(torch.tanh(x) if i else x, weight, bias)
    return np.clip(x.numpy(), *bounds)


def make_vector_env(pool: Pool) -> gymnasium.vector.VectorEnv:
    """EnvPool's environments with the wrappers of CleanRL's file."""
    normalized = wrappers.NormalizeObservation(wrappers.ClipAction(pool), epsilon=_EPSILON)
    pool.observation_statistics = normalized.obs_rms
    clipped = wrappers.TransformObservation(normalized, lambda obs: np.clip(obs, -_BOUND, _BOUND))
    rewards = wrappers.NormalizeReward(clipped, gamma=_DISCOUNT)
    return wrappers.TransformReward(rewards, lambda reward: np.clip(reward, -_BOUND, _BOUND))


def _train(script: Path, pool: Pool, settings: list[str]) -> None:
    """Run CleanRL's file in which `gymnasium.vector.SyncVectorEnv` makes EnvPool's environments."""
    env = make_vector_env(pool)
    with (
        mock.patch.object(gymnasium.vector, "SyncVectorEnv", return_value=env),
        mock.patch.object(sys, "argv", [str(script), *settings]),
        contextlib.suppress(TimeIsOver),
    ):
        pool.keep(runpy.run_path(str(script), run_name="__main__")["agent"])


def main() -> None:
    parser = argparse.ArgumentParser("python benchmarks/cleanrl_training.py", description=_DESCRIPTION)
    parser.add_argument("script", type=Path, metavar="SCRIPT", help="ppo_continuous_action.py in a clone of CleanRL")
    parser.add_argument("--env", choices=BUILT_IN_TASKS, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-steps", type=int, default=10_000_000)
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=256, help="of each environment in a batch")
    parser.add_argument("--every", type=int, default=1_000_000, help="steps between two kept policies")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="after which the training ends")
    parser.add_argument("--episodes", type=int, default=100, help="of the last policy; the others have a fifth of them")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    if not given.script.is_file():
        parser.error(f"{given.script} is no file; give ppo_continuous_action.py of a clone of CleanRL")
    given.out.mkdir(parents=True, exist_ok=True)
    env_id = make_env(given.env, physics="c").gymnasium_id
    pool = Pool(env_id, given.num_envs, given.seed, given.every, given.seconds)
    settings = {"env-id": env_id, "seed": given.seed, "total-timesteps": given.total_steps}
    settings |= {"num-envs": given.num_envs, "num-steps": given.num_steps}
    script, out = given.script.resolve(), given.out.resolve()
    with contextlib.chdir(out):  # CleanRL's file logs to the current folder
        _train(script, pool, [f"--{name}={value}" for name, value in settings.items()])
    write_returns(out, given.env, pool.kept, given.episodes)


if __name__ == "__main__":
    main()
