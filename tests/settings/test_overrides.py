"""Paths and names of any characters on a command line, without Hydra's quotes."""

import os

import pytest

from mjx_walk.experiments import planned_runs
from mjx_walk.settings.config import load_config
from mjx_walk.settings.overrides import complete_overrides
from mjx_walk.settings.saved_config import read_config, save_config
from mjx_walk.storage.files import user_path
from mjx_walk.utils.errors import UserError

_LETTERS = "jos\u00e9 \u65e5\u672c\u3000\U0001f468\u200d\U0001f469"
ODD = f"""{_LETTERS} 50%41 #a?b [x] {{y}} (1) 'q' "d" k=v,c \\ \\' $x ~ ;&|*!@`<>"""
"""No single one of these characters ends or splits a path."""


def test_any_path_is_taken_as_it_is_and_can_be_read_again(tmp_path, monkeypatch):
    home = tmp_path / "home"
    folder = tmp_path / ODD
    folder.mkdir()
    (folder / "model.xml").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(home))
    texts = {"xml_file": f"{ODD}/model.xml", "reward_function": f"{ODD}/mine.py:f"}
    given = [f"run_dir=~/{ODD}", f"wandb_project={ODD}", *(f"env.{key}={text}" for key, text in texts.items())]
    config = load_config(given)
    assert (config.run_dir, config.wandb_project) == (f"{home}/{ODD}", ODD)
    assert (config.env.xml_file, config.env.reward_function) == tuple(f"{tmp_path}/{text}" for text in texts.values())
    save_config(config, tmp_path / "config.yaml")
    assert read_config(tmp_path / "config.yaml") == config
    assert complete_overrides(complete_overrides(given)) == complete_overrides(given)


@pytest.mark.parametrize(
    "text", [" x ", "x,y", "'x','y'", "1e5", "true", "'x", "[x]", "glob(*)", "-x", "\\", "a: b", "\u200e\u05d0\u00ad"]
)
def test_a_text_is_not_read_as_something_else(text):
    assert load_config([f"run_dir={text}"]).run_dir == text


def test_null_quotes_and_interpolations_keep_the_meaning_that_hydra_gives_them():
    assert load_config(["run_dir=null"]).run_dir is None
    assert load_config(["run_dir='x, y'"]).run_dir == "x, y"
    assert load_config(["run_dir=é ${env.name}_${seed}", "seed=3"]).run_dir == "é humanoid_3"
    with pytest.raises(UserError, match="run_dir: Interpolation key 'b' not found"):
        load_config(["run_dir=a${b}"])


def test_what_reads_as_an_interpolation_is_not_saved(tmp_path):
    """A saved configuration with it could not be read again."""
    with pytest.raises(UserError, match=r"^run_dir=a\$\{b\}: '\$\{' names another setting; choose a name without it$"):
        load_config([r"run_dir=a\${b}"])
    with pytest.raises(UserError, match=r"^out=.*\$\{b\}: '\$\{' names another setting; choose a name without it$"):
        planned_runs.plan(["env=walker2d"], ["ppo"], [0], f"{tmp_path}/${{b}}", "cpu")


def test_a_leading_tilde_is_the_home_folder_and_can_be_avoided(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/x")
    expected = {"~": "/home/x", "~/y": "/home/x/y", "./~": f"{tmp_path}/~", "./~x/y": f"{tmp_path}/~x/y", "x~": "x~"}
    for given, path in expected.items():
        assert str(user_path(given)) == str(user_path(user_path(given))) == path
    assert complete_overrides(["hardware=cpu", "hydra.sweep.dir=~/a,b"], is_sweep=True)[1] == (
        "hydra.sweep.dir='/home/x/a,b'"
    )


def test_in_a_sweep_a_comma_separates_paths():
    swept = ["env.xml_file=é.xml,(1).xml,c.xml", "algo.learning_rate=1e-3,3e-4"]
    found = complete_overrides(["hardware=cpu", *swept], is_sweep=True)
    assert found[1:] == ["env.xml_file='é.xml','(1).xml',c.xml", swept[1]]
    (found,) = complete_overrides(["hardware=cpu", "env.xml_file='a,b (1).xml', 2e5 ,it's (2)"], is_sweep=True)[1:]
    assert found == r"env.xml_file='a,b (1).xml','2e5','it\'s (2)'"
    for kept in ("env.xml_file=choice(a,b)", "env.xml_file=null,a.xml", 'env.xml_file="a","b"'):
        assert complete_overrides(["hardware=cpu", kept], is_sweep=True)[1] == kept
    assert load_config(["env.xml_file=a.xml,b.xml"]).env.xml_file == "a.xml,b.xml"


def test_a_comparison_hands_paths_to_its_runs(tmp_path):
    options = (["env=walker2d", "env.xml_file=é.xml,c d.xml", "hardware=cpu"], ["ppo"], [0], str(tmp_path / ODD), "cpu")
    _, runs = planned_runs.plan(*options)
    assert [run.config.env.xml_file for run in runs] == ["é.xml", "c d.xml"]
    assert [load_config(list(run.overrides)).env.xml_file for run in runs] == ["é.xml", "c d.xml"]
    assert all(os.path.dirname(os.path.dirname(run.config.run_dir)) == str(tmp_path / ODD) for run in runs)


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("", "a path is empty"),
        (
            "~nobody_of_this_name/x",
            "there is no such home folder; for a folder of this name write ./~nobody",
        ),
        ("a\nb", r"the path 'a\\nb' has characters that cannot be printed"),
        ("a\x1b[31m", "cannot be printed"),
        ("a\u202eb", "cannot be printed"),
        ("a\udcffb", "cannot be printed"),
        ("a\0b", "cannot be printed"),
    ],
)
def test_a_path_that_cannot_be_used_is_refused_in_one_line(path, says):
    with pytest.raises(UserError, match=says) as error:
        load_config([f"run_dir={path}"])
    assert str(error.value).isprintable()
