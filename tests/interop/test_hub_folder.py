"""Folders to share: other tools read the card, and commands take the folder as a run."""

import re
import shutil

import numpy as np
import pytest
import yaml
from helpers import CLONE, OLD_RUNS, command_here, edit_config
from small_robot import small_robot

import mjx_walk
from mjx_walk.interop.hub_folder import check_shareable
from mjx_walk.storage.scores import read_scores
from mjx_walk.utils.errors import UserError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A policy that plays short episodes."""
    path = tmp_path_factory.mktemp("hub") / "reacher"
    assert command_here("export", "run=zoo:reacher-csac", "format=hub", f"out={path}") == 0
    return path


def test_the_card_has_the_facts_that_the_hub_reads(folder):
    front, page = re.fullmatch(r"---\n(.*?)---\n(.*)", (folder / "README.md").read_text(), re.DOTALL).groups()
    facts = yaml.safe_load(front)
    (model,) = facts["model-index"]
    (result,) = model["results"]
    mean = read_scores(folder / "eval_gymnasium.json").blocks["best"]["mean"]
    assert model["name"] == "reacher" and result["dataset"]["name"] == "Reacher-v5"
    assert result["metrics"][0]["value"].startswith(f"{mean:.2f} +/- ") and f"| {mean:,.1f} | " in page
    assert {"Reacher-v5", "csac", "reinforcement-learning"} <= {*facts["tags"]}
    assert "python -m mjx_walk.train env=reacher algo=csac algo.n_step=5 algo.noise_repeat=8\n" in page
    assert (folder / "replay.mp4").exists() == ("replay.mp4" in page)


def test_the_folder_is_a_run(folder, capsys):
    original, shared = (mjx_walk.load_run(run, physics="c") for run in ("zoo:reacher-csac", folder))
    observations = np.random.default_rng(0).normal(size=(8, original.task.observation_size))
    np.testing.assert_array_equal(shared.policy(observations), original.policy(observations))
    assert command_here("eval", f"run={folder}", "episodes=2") == 0
    assert "Best policy" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} - {"replay.mp4"} == {
        *("README.md", "checkpoints", "config.yaml", "eval_gymnasium.json", "policy.onnx")
    }


def test_no_path_of_the_user_is_shared(folder):
    shared = (folder / "config.yaml").read_text() + (folder / "README.md").read_text()
    assert str(folder.parent) not in shared and str(CLONE) not in shared


def test_the_command_is_that_of_the_training(tmp_path):
    """Also where a policy is scored without the run's reward and randomized physics."""
    run = shutil.copytree(OLD_RUNS / "ppo", tmp_path / "run")
    own = "  reward_function: /home/me/r.py:f\n  randomize:\n    observation_noise: 0.01\n"
    edit_config(run, "  reward_function: null\n", own)
    command = mjx_walk.load_run(run, physics="c").command
    assert "env.reward_function=r.py:f" in command and "/home" not in command and "env.randomize" in command


def test_an_existing_folder_stays(folder, capsys):
    before = (folder / "README.md").stat().st_mtime_ns
    assert command_here("export", "run=zoo:reacher-csac", "format=hub", f"out={folder}") == 2
    assert "exists already; choose another out=" in capsys.readouterr().err
    assert (folder / "README.md").stat().st_mtime_ns == before


def test_what_others_lack_is_refused(tmp_path):
    run = mjx_walk.load_run("zoo:reacher-csac", physics="c")
    robot = tmp_path / "robot.xml"
    robot.write_text(small_robot())
    run.task = mjx_walk.make_env("locomotion", "c", xml_file=str(robot))
    with pytest.raises(
        UserError, match=r"^format=hub shares policies of Gymnasium's tasks, and others lack .*robot.xml;"
    ):
        check_shareable(run)
