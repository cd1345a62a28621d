"""Facts of a checkpoint are checked before they are used."""

import numpy as np
import pytest

from mjx_walk.storage import checkpoint
from mjx_walk.storage.checkpoint_metadata import read_metadata, write_metadata
from mjx_walk.utils.errors import UserError

ARRAYS = {"a": np.arange(3, dtype=np.float32)}


def saved(tmp_path, **metadata):
    path = checkpoint.step_path(tmp_path, 10)
    checkpoint.save(path, ARRAYS, {"env_steps": 10, "wall_seconds": 1.0})
    write_metadata(path / "meta.json", read_metadata(path / "meta.json") | metadata)
    return path


@pytest.mark.parametrize(
    ("name", "value", "valid"),
    [
        *(("env_steps", value, "a whole number from 0") for value in (-1, True, 1.5, "10", None, [], 2**63, 10**4000)),
        *(("wall_seconds", value, "a number from 0") for value in (float("nan"), float("inf"), -1, "1", True, 10**400)),
        *(("num_devices", value, "a whole number from 1") for value in (0, -1, False, "2", 10**9)),
        *(("eval_return", value, "a finite number") for value in (float("nan"), "high", {})),
        *(("crc32", value, "whole numbers by name") for value in ([], {"a": "x"}, {"a": None}, 7)),
        ("format", "1", "a whole number from 0"),
        ("mjx_walk", "1\x1b[2J\n", "a version"),
    ],
)
def test_a_fact_of_another_type_is_named(tmp_path, name, value, valid):
    path = saved(tmp_path, **{name: value})
    with pytest.raises(ValueError, match=f"{name} should be {valid}.*, found ") as error:
        checkpoint.restore(path, ARRAYS)
    assert str(path / "meta.json") in str(error.value) and str(error.value).isprintable()
    with pytest.warns(UserWarning, match=f"{name} should be"), pytest.raises(UserError, match="no usable checkpoint"):
        checkpoint.restore_newest(tmp_path, ARRAYS)


@pytest.mark.parametrize("text", ["[" * 100_000, "[]", "7", '{"env_steps": ' + "1" * 5000 + "}", "", "{}", "\0"])
def test_facts_that_are_no_facts_are_damage(tmp_path, text):
    path = saved(tmp_path)
    (path / "meta.json").write_text(text)
    with pytest.raises(ValueError, match=r"meta\.json") as error:
        checkpoint.restore(path, ARRAYS)
    assert str(error.value).isprintable()


def test_unknown_facts_are_ignored_and_facts_that_are_too_large_are_refused(tmp_path):
    path = saved(tmp_path, more={"deep": [1, {}]})
    assert checkpoint.restore(path, ARRAYS)[1]["env_steps"] == 10
    (path / "meta.json").write_text(" " * 2_000_001)
    with pytest.raises(ValueError, match="larger than 2,000,000 bytes"):
        checkpoint.restore(path, ARRAYS)
