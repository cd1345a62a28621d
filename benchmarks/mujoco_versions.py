"""`python benchmarks/mujoco_versions.py FILE.onnx …`: score exported policies with the installed MuJoCo.

It needs only gymnasium, mujoco and onnxruntime, so that it runs in a virtual environment with another MuJoCo than that
of the training.
"""

import argparse
import csv
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import onnxruntime

__all__ = ["play"]

_DESCRIPTION = """
Score policies that python -m mjx_walk.export wrote, in Gymnasium with the installed MuJoCo. Print CSV, a row for each.
"""


def main() -> None:
    parser = argparse.ArgumentParser("python benchmarks/mujoco_versions.py", description=_DESCRIPTION)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=10_000)
    given = parser.parse_args()
    rows = csv.writer(sys.stdout)
    rows.writerow(("Policy", "MuJoCo", "Episodes", "Mean", "Std"))
    seeds = range(given.seed, given.seed + given.episodes)
    with ProcessPoolExecutor() as pool:
        for file in given.files:
            returns = list(pool.map(play, [file] * len(seeds), seeds))
            std = np.std(returns, ddof=1) if len(returns) > 1 else 0.0
            rows.writerow((file.stem, mujoco.__version__, len(returns), f"{np.mean(returns):.2f}", f"{std:.2f}"))
            sys.stdout.flush()


def play(file: Path, seed: int) -> float:
    """The return of one episode of a policy's own task in Gymnasium."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    policy = onnxruntime.InferenceSession(file, options)
    facts = policy.get_modelmeta().custom_metadata_map
    env = gymnasium.make(facts["task"], **json.loads(facts["keywords"]))
    obs, _ = env.reset(seed=seed)
    total, is_over = 0.0, False
    while not is_over:
        (actions,) = policy.run(None, {"observation": obs[None]})
        obs, reward, terminated, truncated, _ = env.step(actions[0])
        total, is_over = total + float(reward), terminated or truncated
    return total


if __name__ == "__main__":
    main()
