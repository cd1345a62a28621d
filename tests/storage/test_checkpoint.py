"""Saved and restored TrainStates: exact, atomic, checked."""

import errno
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flip_a_byte

from mjx_walk.storage import arrays, checkpoint, checksums
from mjx_walk.storage.arrays import _as_os_error
from mjx_walk.storage.background_saver import BackgroundSaver, Part
from mjx_walk.storage.checkpoint_metadata import read_metadata, write_metadata
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

    monkeypatch.setattr("mjx_walk.storage.folders.os.replace", crash)
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


def test_of_folders_saved_together_each_can_go_back_until_all_are_saved(tmp_path):
    saver = BackgroundSaver(tmp_path, max_to_keep=1, prune_first=True)
    state = {"a": jnp.ones(2), "replay": {"b": jnp.ones(3)}}
    for steps, kept in ((10, [10]), (20, [10, 20]), (20, [10, 20]), (30, [20, 30])):
        saver.save(Part(checkpoint.step_path(tmp_path, steps), state, {"env_steps": steps}))
        saver.wait()
        saved = checkpoint.list_steps(tmp_path)
        assert [int(path.name) for path in saved] == kept and all((path / "replay").is_dir() for path in saved)
    saver.prune()
    assert [int(path.name) for path in checkpoint.list_steps(tmp_path)] == [30]


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (
            PermissionError(errno.EACCES, "Permission denied"),
            "cannot read .*20.*: Permission denied; once it can be read",
        ),
        (OSError(errno.ESTALE, "Stale file handle"), "cannot read .*20.*: Stale file handle; once it can be read"),
        (MemoryError(), "not enough memory to read .*20; free some"),
    ],
)
@pytest.mark.parametrize("reader", ["checksums.read_bytes", "arrays._read_numpy"])
def test_what_cannot_be_read_now_is_not_passed_over(tmp_path, monkeypatch, error, says, reader):
    for steps in (10, 20):
        path = checkpoint.step_path(tmp_path, steps)
        checkpoint.save(path, {"a": jnp.ones(2)}, {"env_steps": steps}, as_numpy=True)

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(
        {"checksums": checksums, "arrays": arrays}[reader.partition(".")[0]], reader.partition(".")[2], fail
    )
    with pytest.raises(UserError, match=says):
        checkpoint.restore_newest(tmp_path, {"a": jnp.ones(2)})


def test_another_shape_or_version_is_named(tmp_path):
    checkpoint.save(tmp_path / "x", TREE, {"env_steps": 0})
    with pytest.raises(UserError, match=r"a should be \(2, 4\) float32, found \(2, 3\) float32"):
        checkpoint.restore(tmp_path / "x", TREE | {"a": jnp.zeros((2, 4))})
    meta = json.loads((tmp_path / "x" / "meta.json").read_text())
    (tmp_path / "x" / "meta.json").write_text(json.dumps(meta | {"format": 99, "mjx_walk": "9.9"}))
    with pytest.raises(UserError, match=r"has checkpoint format 99, written by mjx_walk 9\.9"):
        checkpoint.restore(tmp_path / "x", TREE)


def refused_or_equal(path):
    """Whether a checkpoint is refused, or gives what was saved."""
    try:
        tree, meta = checkpoint.restore(path, TREE)
    except ValueError:
        return True
    expected = {"env_steps": 10, "wall_seconds": 2.5, "num_devices": 1}
    return {name: meta.get(name) for name in expected} == expected and np.array_equal(tree["a"], TREE["a"])


def test_no_changed_character_of_the_facts_goes_unnoticed(tmp_path):
    path, metadata = checkpoint.step_path(tmp_path, 10), {"env_steps": 10, "wall_seconds": 2.5, "num_devices": 1}
    checkpoint.save(path, TREE, metadata, as_numpy=True)
    meta = path / "meta.json"
    text = meta.read_text()
    for i, character in enumerate(text):
        other = str((int(character) + 1) % 10) if character.isdigit() else "x"
        meta.write_text(text[:i] + other + text[i + 1 :])
        assert refused_or_equal(path), (i, character)
    meta.write_text(text.replace('"env_steps": 10', '"env_steps": 70'))
    with pytest.raises(ValueError, match=r"is damaged: meta\.json does not match its checksum"):
        checkpoint.restore(path, TREE)


@pytest.mark.parametrize("steps", [10, 11])
def test_facts_of_an_earlier_version_are_those_of_their_own_step(tmp_path, steps):
    """They have no checksum."""
    path = checkpoint.step_path(tmp_path, 10)
    checkpoint.save(path, TREE, {"env_steps": 10}, as_numpy=True)
    meta = json.loads((path / "meta.json").read_text())
    del meta["checksum"]
    (path / "meta.json").write_text(json.dumps(meta | {"env_steps": steps}))
    if steps == 10:
        assert checkpoint.restore_newest(tmp_path, TREE)[1]["env_steps"] == 10
        return
    with pytest.warns(UserWarning, match="its metadata are of step 11"), pytest.raises(UserError):
        checkpoint.restore_newest(tmp_path, TREE)


@pytest.mark.parametrize("damage", ["format", "shape", "configuration", "no configuration", "no metadata", "no arrays"])
def test_whatever_is_wrong_with_a_checkpoint_the_one_before_is_used(tmp_path, damage):
    for steps in (10, 20):
        tree = TREE | {"a": jnp.zeros(9)} if (damage, steps) == ("shape", 20) else TREE
        checkpoint.save(checkpoint.step_path(tmp_path, steps), tree, {"env_steps": steps}, True, "seed: 0")
    newest = checkpoint.step_path(tmp_path, 20)
    if damage == "format":
        write_metadata(newest / "meta.json", read_metadata(newest / "meta.json") | {"format": 9})
    elif damage == "configuration":
        (newest / "run_config.yaml").write_text("seed: 1")
    elif damage in ("no configuration", "no metadata"):
        (newest / {"no configuration": "run_config.yaml", "no metadata": "meta.json"}[damage]).unlink()
    elif damage == "no arrays":
        shutil.rmtree(newest / "arrays")
    with pytest.warns(UserWarning, match=f"{newest}.*; falling back to the previous checkpoint"):
        assert checkpoint.restore_newest(tmp_path, TREE)[1]["env_steps"] == 10


def test_a_full_disk_is_an_error_about_the_disk(tmp_path, monkeypatch):
    checkpoint.save(tmp_path / "best", TREE, {"env_steps": 1})
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("mjx_walk.storage.arrays.shutil.disk_usage", lambda path: usage._replace(free=10))
    with pytest.raises(OSError, match="No space left on device") as error:
        checkpoint.save(tmp_path / "best", TREE, {"env_steps": 2})
    assert error.value.errno == errno.ENOSPC
    assert [path.name for path in tmp_path.iterdir()] == ["best"]
    assert checkpoint.read_meta(tmp_path / "best")["env_steps"] == 1


def test_an_error_of_the_disk_inside_tensorstore_is_one_too(tmp_path):
    with pytest.raises(OSError, match="Input/output error") as error, _as_os_error(tmp_path):
        raise ValueError("INTERNAL: Failed to write 5 bytes to file 14: Input/output error [os_error_code='5']")
    assert (error.value.errno, error.value.filename) == (errno.EIO, str(tmp_path))
