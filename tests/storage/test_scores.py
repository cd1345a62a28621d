"""A file of scores that a stranger has written."""

import json

import pytest

from mjx_walk.storage.scores import read_scores, write_scores

BLOCK = {"mean": 1.0, "std": 0.5}


@pytest.mark.parametrize("name", ["path", "blocks", "metadata", "env", "best", "versions", "checksum"])
def test_a_fact_of_any_name_neither_stops_nor_replaces_new_scores(tmp_path, name):
    path = tmp_path / "eval_gymnasium.json"
    one_block = {"returns": [2.0], "mean": 2.0, "std": 0.0}  # in which every other name is a fact
    path.write_text(json.dumps(one_block | {name: "theirs"} if name != "checksum" else one_block))
    try:
        former = read_scores(path)
    except ValueError:
        return  # a checksum, or another name of the file itself
    write_scores(path, "Hopper-v5", {"best": BLOCK}, former.metadata)
    found = read_scores(path)
    assert (found.env, found.blocks) == ("Hopper-v5", {"best": BLOCK})
    assert isinstance(found.metadata["versions"], dict)


@pytest.mark.parametrize("depth", [30, 500, 900, 990, 100_000])
def test_scores_that_are_nested_too_deeply_to_be_written_are_not_read(tmp_path, depth):
    path = tmp_path / "eval_gymnasium.json"
    path.write_text(f'{{"best": {json.dumps(BLOCK)}, "checksum": 1, "more": {"[" * depth}{"]" * depth}}}')
    with pytest.raises(ValueError, match="holds no scores: it is nested too deeply"):
        read_scores(path)


def test_scores_of_any_size_take_little_memory(tmp_path):
    path = tmp_path / "eval_gymnasium.json"
    with path.open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(ValueError, match="holds no scores: it is larger than 10,000,000 bytes"):
        read_scores(path)
