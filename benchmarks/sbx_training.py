"""`python benchmarks/sbx_training.py --algo tqc --env humanoid --out DIR`: returns of SBX over steps and seconds."""

import argparse
import dataclasses
import functools
import pickle
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import sbx
from peer_returns import KeptPolicy, write_returns
from sbx.common.off_policy_algorithm import OffPolicyAlgorithmJax
from stable_baselines3.common.callbacks import BaseCallback

from mjx_walk.envs import BUILT_IN_TASKS, make_env
from mjx_walk.storage.folders import replacing_folder
from mjx_walk.utils.errors import UserError

__all__ = ["Keeper", "Kept", "resumed"]

_DESCRIPTION = """
Train SAC or TQC of Stable-Baselines JAX (SBX) in one environment of Gymnasium. Settings are those of rl-baselines3-zoo
for MuJoCo: SBX's defaults and 10,000 random steps. Policies are kept on the way. At the end, score them on the episodes
of `python -m mjx_walk.eval` and write DIR/returns.csv. After --seconds the training is saved, and the same command
continues it.
"""
_ALGORITHMS = {"sac": sbx.SAC, "tqc": sbx.TQC}
_LEARNING_STARTS = 10_000


@dataclasses.dataclass
class Kept:
    """A policy on the way."""

    steps: int
    seconds: float
    """Of training until then, with compiling and without saving."""
    params: Any
    """Of the actor, on the host."""


class Keeper(BaseCallback):
    """Keeps policies, and ends the training after a time.

    Args:
        every: steps between two policies.
        seconds: of this call.
        kept: policies so far.
    """

    def __init__(self, every: int, seconds: float, kept: list[Kept]):
        super().__init__()
        self.kept = kept
        self._every = every
        self._seconds = seconds
        self._before = kept[-1].seconds if kept else 0.0
        self._started = time.monotonic()

    def keep(self) -> None:
        """Keep the present policy, in place of one of the same step."""
        if self.kept and self.kept[-1].steps == self.num_timesteps:
            self.kept.pop()
        policy: Any = self.model.policy
        params = jax.device_get(policy.actor_state.params)
        self.kept.append(Kept(self.num_timesteps, self._before + time.monotonic() - self._started, params))

    def _on_step(self) -> bool:
        if self.num_timesteps % self._every == 0:
            self.keep()
        return time.monotonic() - self._started < self._seconds


def resumed(folder: Path, algo: str, env: gymnasium.Env, seed: int) -> tuple[OffPolicyAlgorithmJax, list[Kept]]:
    """The training of a folder as it was saved, with the policies kept so far; a new one in an empty folder.

    Raises:
        UserError: the folder holds another training.
    """
    kind, asked = _ALGORITHMS[algo], _facts(algo, env, seed)
    if not folder.exists():
        return kind("MlpPolicy", env, seed=seed, learning_starts=_LEARNING_STARTS), []
    facts, kept = pickle.loads((folder / "kept.pickle").read_bytes())
    if facts != asked:
        raise UserError(f"{folder} is {facts}, not {asked}; choose another --out")
    model = kind.load(folder / "model.zip", env)
    model.load_replay_buffer(folder / "replay.pkl")
    return model, kept


def _facts(algo: str, env: gymnasium.Env, seed: int) -> str:
    assert env.spec
    return f"{algo} on {env.spec.id}, seed {seed}"


def _save(folder: Path, model: OffPolicyAlgorithmJax, facts: str, kept: list[Kept]) -> None:
    """Save a training, all of its files at once."""
    with replacing_folder(folder) as new:
        model.save(new / "model.zip")
        model.save_replay_buffer(new / "replay.pkl")
        (new / "kept.pickle").write_bytes(pickle.dumps((facts, kept)))


def _act(model: OffPolicyAlgorithmJax, params: Any, obs: np.ndarray) -> np.ndarray:
    """Actions of a kept policy, without noise."""
    model.policy.actor_state = model.policy.actor_state.replace(params=params)
    return model.predict(obs, deterministic=True)[0]


def main() -> None:
    parser = argparse.ArgumentParser("python benchmarks/sbx_training.py", description=_DESCRIPTION)
    parser.add_argument("--algo", choices=_ALGORITHMS, default="tqc")
    parser.add_argument("--env", choices=BUILT_IN_TASKS, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-steps", type=int, default=1_000_000)
    parser.add_argument("--every", type=int, default=100_000, help="steps between two kept policies")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="of this call, after which it is saved")
    parser.add_argument("--episodes", type=int, default=100, help="of the last policy; the others have a fifth of them")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    env = gymnasium.make(make_env(given.env, physics="c").gymnasium_id)
    model, kept = resumed(given.out / "training", given.algo, env, given.seed)
    keeper = Keeper(given.every, given.seconds, kept)
    left = given.total_steps - model.num_timesteps
    if left > 0:
        model.learn(left, keeper, reset_num_timesteps=not kept)
        keeper.keep()
        _save(given.out / "training", model, _facts(given.algo, env, given.seed), kept)
    policies = [KeptPolicy(x.steps, x.seconds, functools.partial(_act, model, x.params)) for x in kept]
    write_returns(given.out, given.env, policies, given.episodes)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(f"error: {error}")
