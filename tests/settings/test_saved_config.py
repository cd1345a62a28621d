"""Which configuration counts: the one that the newest checkpoint was trained with."""

import dataclasses

import numpy as np
import pytest

from mjx_walk.settings.config import flatten, load_config
from mjx_walk.settings.saved_config import as_yaml, differences, differing_values, read_saved_config, save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder, open_existing
from mjx_walk.utils.errors import UserError


@pytest.fixture(scope="module")
def trained():
    return load_config(["env=walker2d", "hardware=cpu", "total_steps=640", "env.xml_file=/old/mine.xml"])


@pytest.fixture
def folder(tmp_path, trained):
    """A run folder with two checkpoints."""
    folder = RunFolder(tmp_path)
    for steps in (64, 128):
        path = checkpoint.step_path(folder.checkpoints, steps)
        checkpoint.save(path, {"a": np.zeros(2)}, {"env_steps": steps}, as_numpy=True, config=as_yaml(trained))
    save_config(trained, folder.config)
    return folder


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_an_edited_configuration_is_named_and_the_checkpoint_s_counts(folder, trained, recwarn):
    assert read_saved_config(folder) == trained and not recwarn
    edit(folder.config, "discount: 0.99", "discount: 0.98")
    says = (
        r"config.yaml differs from the checkpoint: algo.discount \(was 0.99, now 0.98\); .*0128/run_config.yaml is used"
    )
    with pytest.warns(UserWarning, match=says):
        assert read_saved_config(folder) == trained


@pytest.mark.parametrize("content", [None, "", "seed: [", "\0" * 500, "seed: many"])
def test_a_configuration_that_is_lost_is_in_the_checkpoint(folder, trained, content):
    folder.config.unlink() if content is None else folder.config.write_text(content)
    assert open_existing(folder.path) == folder
    with pytest.warns(UserWarning, match=r"config\.yaml.*; the copy in .*0128/run_config\.yaml is used"):
        assert read_saved_config(folder) == trained


def test_a_damaged_copy_is_passed_over(folder, trained):
    copies = [checkpoint.step_path(folder.checkpoints, steps) / "run_config.yaml" for steps in (64, 128)]
    assert folder.config_copy() == copies[1]
    edit(copies[1], "discount: 0.99", "discount: 0.98")
    assert folder.config_copy() == copies[0]
    edit(copies[0], "seed: 0", "seed: 1")
    assert folder.config_copy() is None and read_saved_config(folder) == trained
    folder.config.unlink()
    with pytest.raises(UserError, match="no run at"):
        open_existing(folder.path)


def test_what_may_change_comes_from_the_file_and_a_length_is_named(folder, trained):
    changed = dataclasses.replace(trained, total_steps=1280, wandb_project="mine", run_dir="elsewhere")
    changed = dataclasses.replace(changed, env=dataclasses.replace(changed.env, xml_file="/new/mine.xml"))
    save_config(changed, folder.config)
    with pytest.warns(UserWarning, match=r"changes the run's length: total_steps \(was 640, now 1280\)"):
        assert read_saved_config(folder) == changed


def test_runs_and_studies_word_their_differences_alike(trained):
    """A study compares plain values, some of which only one side has."""
    changed = dataclasses.replace(trained, seed=3, total_steps=1280)
    assert differences(trained, changed) == ["seed (was 0, now 3)"]
    old, new = flatten(trained), flatten(changed) | {"search algo.discount": "0.9,0.99"}
    assert differing_values(old, new, ("total_steps",)) == [
        "search algo.discount (was None, now 0.9,0.99)",
        *differences(trained, changed),
    ]
