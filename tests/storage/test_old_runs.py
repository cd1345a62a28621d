"""Runs of an earlier version load, act and resume with the results of the version that wrote them."""

import gzip
import shutil

import flax
import jax
import numpy as np
import pytest
from helpers import OLD_RUNS, slow_except, train_here

import mjx_walk
from mjx_walk.storage import checkpoint

OBSERVATION = np.linspace(-1.0, 1.0, 17, dtype=np.float32)


@pytest.mark.parametrize(
    "algo", slow_except(["ppo", "sac"], sorted(path.name for path in OLD_RUNS.iterdir() if path.is_dir()))
)
def test_an_old_run_loads_acts_and_resumes(algo, tmp_path):
    """`expected` holds an action, and the leaves after two more iterations, by their old names.

    They resume with `JAX_DEBUG_NANS=1` and `JAX_DEBUG_INFS=1`, which stop at any NaN and infinity, with
    `JAX_ENABLE_X64=1`, and with `JAX_TRANSFER_GUARD=disallow`.
    """
    run_dir = shutil.copytree(OLD_RUNS / algo, tmp_path / "run")
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
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        np.testing.assert_allclose(leaf, leaves[name], rtol=1e-5, atol=1e-5, err_msg=name)
