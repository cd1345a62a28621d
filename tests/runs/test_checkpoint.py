"""Saved and restored TrainStates: exact, atomic, checked."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flip_a_byte

from mjx_walk.runs import checkpoint
from mjx_walk.utils.errors import UserError

TREE = {
    "a": jnp.arange(6, dtype=jnp.float32).reshape(2, 3),
    "b": {"key": jnp.array([1, 2], jnp.uint32), "flag": jnp.array([True, False]), "n": jnp.array(7, jnp.int32)},
}


def test_round_trip_keeps_every_bit_and_type(tmp_path):
    checkpoint.save(tmp_path / "x", TREE, {"env_steps": 3})
    tree, meta = checkpoint.restore(tmp_path / "x", TREE)
    assert meta["env_steps"] == 3
    for name in ("a",):
        np.testing.assert_array_equal(tree[name], TREE[name])
    for name, leaf in TREE["b"].items():
        np.testing.assert_array_equal(tree["b"][name], leaf)
        assert tree["b"][name].dtype == leaf.dtype


def test_damage_falls_back_to_the_checkpoint_before(tmp_path):
    for steps in (10, 20):
        checkpoint.save(checkpoint.step_path(tmp_path, steps), TREE, {"env_steps": steps})
    flip_a_byte(checkpoint.step_path(tmp_path, 20))
    with pytest.warns(UserWarning, match="damaged"):
        _, meta = checkpoint.restore_newest(tmp_path, TREE)
    assert meta["env_steps"] == 10
    (checkpoint.step_path(tmp_path, 10) / "meta.json").unlink()
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(UserError, match="no usable checkpoint"):
        checkpoint.restore_newest(tmp_path, TREE)


def test_an_interrupted_save_leaves_the_last_one_alone(tmp_path, monkeypatch):
    path = checkpoint.step_path(tmp_path, 10)
    checkpoint.save(path, TREE, {"env_steps": 10})

    def crash(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("mjx_walk.utils.folders.os.replace", crash)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(checkpoint.step_path(tmp_path, 20), TREE, {"env_steps": 20})
    assert checkpoint.list_steps(tmp_path) == [path]
    checkpoint.prune(tmp_path, 1)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_only_the_newest_are_kept(tmp_path):
    for steps in (5, 100, 20):
        checkpoint.save(checkpoint.step_path(tmp_path, steps), TREE, {"env_steps": steps})
    checkpoint.prune(tmp_path, 2)
    assert [int(p.name) for p in checkpoint.list_steps(tmp_path)] == [20, 100]


def test_another_shape_or_version_is_named(tmp_path):
    checkpoint.save(tmp_path / "x", TREE, {"env_steps": 0})
    with pytest.raises(UserError, match=r"a should be \(2, 4\) float32, found \(2, 3\) float32"):
        checkpoint.restore(tmp_path / "x", TREE | {"a": jnp.zeros((2, 4))})
    meta = json.loads((tmp_path / "x" / "meta.json").read_text())
    (tmp_path / "x" / "meta.json").write_text(json.dumps(meta | {"format": 99, "mjx_walk": "9.9"}))
    with pytest.raises(UserError, match=r"has checkpoint format 99, written by mjx_walk 9\.9"):
        checkpoint.restore(tmp_path / "x", TREE)
