"""`python make.py OUT [EPISODES ALGO…]`: write a small run folder for algorithms, with the results of resuming it.

An earlier version writes them, with its tree first on PYTHONPATH. Folders here are from 9c96b95, without scores, and
from bc351bb, with that name at their end, and scored in two episodes. Settings have the names of 9c96b95.
Each folder holds a run of two iterations and `expected.msgpack.gz`: the deterministic action for `OBSERVATION`, and all
leaves after two more iterations.
"""

import gzip
import os
import shutil
import sys
from pathlib import Path

import flax
import numpy as np
import orbax.checkpoint as ocp

OBSERVATION = np.linspace(-1.0, 1.0, 17, dtype=np.float32)
"""An observation of Walker2d."""

_COMMON = (
    *("env=walker2d", "physics=c", "hardware=cpu", "num_envs=2", "env.max_episode_steps=3", "updates_per_chunk=1"),
    *("evaluation.num_envs=1", "checkpoint.every_chunks=1", "checkpoint.keep=1"),
    *("algo.unroll_length=4", "algo.schedule_steps=1000", "algo.policy_hidden_layer_sizes=[4]"),
)
_ON_POLICY = (
    *("algo.measured_steps=4", "algo.num_unrolls=1", "algo.num_minibatches=2", "algo.normalize_rewards=true"),
    *("algo.value_hidden_layer_sizes=[4]", "algo.entropy_cost=0.01"),
)
_OFF_POLICY = (
    *("algo.updates_per_step=1", "algo.batch_size=8", "algo.replay_capacity=64", "algo.prefill_steps=8"),
    *("algo.normalize_rewards=true", "algo.return_bound=3"),
    "algo.critic_hidden_layer_sizes=[16]",  # the layer norm of 4 units magnifies the rounding of other CPUs 100 times
    "algo.network_dtype=float32",  # the recipes' bfloat16 rounds differently on other machines
)
_OWN = {
    "ppo": (*_ON_POLICY, "algo.num_epochs=1"),
    "a2c": (*_ON_POLICY, "algo.ou_noise_std=0.1"),
    "reinforce": (*_ON_POLICY, "algo.discount=0.5"),
    "sac": _OFF_POLICY,
    "csac": (*_OFF_POLICY, "algo.num_atoms=11"),
    "td3": _OFF_POLICY,
    "ddpg": _OFF_POLICY,
}


def main(out: Path, episodes: str = "0", *algos: str) -> None:
    from mjx_walk import load_run
    from mjx_walk.train import main as train

    os.chdir(out)  # the saved configurations name relative folders
    for algo in algos or _OWN:
        own = (*_OWN[algo], f"evaluation.gymnasium_episodes={episodes}")
        run, longer = Path(algo), Path(f"{algo}_longer")
        train([f"algo={algo}", *_COMMON, *own, f"run_dir={run}", "total_steps=16"])
        shutil.copytree(run, longer)
        train([f"run_dir={longer}", "resume=true", "total_steps=32"])
        (newest,) = (longer / "checkpoints").glob("0*")
        with ocp.PyTreeCheckpointer() as checkpointer:
            parts = [checkpointer.restore(part.absolute()) for part in newest.iterdir() if part.is_dir()]
        leaves = {name: leaf for part in parts for name, leaf in part.items()}
        expected = {"action": load_run(run).policy(OBSERVATION), "leaves": leaves}
        content = flax.serialization.msgpack_serialize(expected)
        (run / "expected.msgpack.gz").write_bytes(gzip.compress(content, mtime=0))
        shutil.rmtree(longer)
        for path in [*run.glob("*.png"), *run.glob("events.*"), *run.glob(".lock"), run / "metrics.csv"]:
            path.unlink()
        for path in run.rglob("commit_success.txt"):
            path.write_text("Checkpoint commit was successful")  # without the folder's absolute path


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
