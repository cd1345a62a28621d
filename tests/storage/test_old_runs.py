"""Runs of earlier versions load, act, score and resume with the results of the version that wrote them."""

import gzip
import shutil

import flax
import jax
import numpy as np
import pytest
from helpers import OLD_RUNS, command_here, slow_except, train_here

import mjx_walk
from mjx_walk.storage import checkpoint
from mjx_walk.storage.scores import read_scores

OBSERVATION = np.linspace(-1.0, 1.0, 17, dtype=np.float32)


RUNS = sorted(path.name for path in OLD_RUNS.iterdir() if path.is_dir())


@pytest.mark.parametrize("name", slow_except(["ppo", "sac"], RUNS))
def test_an_old_run_loads_acts_and_resumes(name, tmp_path):
    """`expected` holds an action, and the leaves after two more iterations, by their old names.

    They resume with `JAX_DEBUG_NANS=1` and `JAX_DEBUG_INFS=1`, which stop at any NaN and infinity, with
    `JAX_ENABLE_X64=1`, and with `JAX_TRANSFER_GUARD=disallow`.
    """
    run_dir = shutil.copytree(OLD_RUNS / name, tmp_path / "run")
    expected = flax.serialization.msgpack_restore(gzip.decompress((run_dir / "expected.msgpack.gz").read_bytes()))
    with jax.enable_x64(True):
        run = mjx_walk.load_run(run_dir)
    np.testing.assert_allclose(run.policy(OBSERVATION), expected["action"], atol=1e-5)
    with jax.debug_nans(True), jax.debug_infs(True), jax.enable_x64(True), jax.transfer_guard("disallow"):
        train_here(run_dir, "resume=true", "total_steps=32", tiny=[])
    newest = checkpoint.list_steps(run_dir / "checkpoints")[-1]
    like = jax.eval_shape(run.algorithm.init, jax.random.PRNGKey(0))
    found, metadata = checkpoint.restore(newest, like)
    assert metadata["env_steps"] == 32
    leaves = {checkpoint.present_name(name): leaf for name, leaf in expected["leaves"].items()}
    named = jax.tree_util.tree_leaves_with_path(found)
    assert len(named) == len(leaves)
    for path, leaf in named:
        leaf_name = jax.tree_util.keystr(path, simple=True, separator=".")
        if leaf_name == "env.pool.steps" and run.algorithm.env.random_step_after_falls:  # were 0
            assert (leaf >= 0).all() and (leaf < run.task.max_episode_steps).all()
            continue
        np.testing.assert_allclose(leaf, leaves[leaf_name], rtol=1e-5, atol=1e-5, err_msg=leaf_name)


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_an_old_run_is_scored(name, tmp_path):
    """As the version that wrote it has scored it, if it did."""
    run_dir = shutil.copytree(OLD_RUNS / name, tmp_path / "run")
    path = run_dir / "eval_gymnasium.json"
    former = read_scores(path).blocks if path.exists() else {}
    for policy in ("final", "best"):
        assert command_here("eval", f"run={run_dir}", f"policy={policy}", "episodes=2") == 0
    scored = read_scores(path).blocks
    assert scored.keys() == {"final", "best"}
    for policy, block in former.items():
        np.testing.assert_allclose(scored[policy]["returns"], block["returns"], rtol=1e-5)
        assert scored[policy]["env_steps"] == block["env_steps"]
