"""The policies that come with the package."""

import copy
import pickle
import shlex

import numpy as np
import pytest
from helpers import command, command_here, slow_except

import mjx_walk
from mjx_walk import zoo
from mjx_walk.settings.config import flatten, load_config, training_command
from mjx_walk.settings.saved_config import read_config
from mjx_walk.storage.scores import read_scores
from mjx_walk.utils.setting_fields import has_effect

NAMES = zoo.names()
FAST = ("humanoid-csac", "humanoid_standup-td3", "walker2d-ppo", "pusher-csac")


def test_three_tasks_and_the_main_algorithms_are_there():
    wanted = {f"{env}-{algo}" for env in ("humanoid", "humanoid_standup", "walker2d") for algo in ("ppo", "sac", "td3")}
    assert wanted | {"humanoid-csac"} <= set(NAMES)


@pytest.mark.parametrize("name", slow_except(FAST, NAMES))
def test_a_policy_is_small_and_scores_about_what_it_did(name):
    folder = zoo.open_run(f"zoo:{name}")
    assert sum(path.stat().st_size for path in folder.path.rglob("*") if path.is_file()) < 1_000_000
    block = read_scores(folder.gymnasium_scores).blocks["best"]
    assert block["seeds"] == list(range(10_000, 10_100)) and len(block["returns"]) == 100
    assert np.mean(block["returns"]) == pytest.approx(block["mean"])
    assert np.std(block["returns"], ddof=1) == pytest.approx(block["std"])
    run = mjx_walk.load_run(f"zoo:{name}")
    scores = run.evaluate(episodes=1, seed=10_000)
    assert scores.mean == pytest.approx(block["returns"][0], rel=0.2)


@pytest.mark.parametrize("name", slow_except(FAST, NAMES))
def test_its_command_gives_its_settings(name):
    folder = zoo.open_run(f"zoo:{name}")
    config = read_config(folder.config)
    command = read_scores(folder.gymnasium_scores).metadata["command"]
    assert command == training_command(config)
    words = shlex.split(command)
    assert words[:3] == ["python", "-m", "mjx_walk.train"]
    asked, own = flatten(load_config(["hardware=gpu", *words[3:]])), flatten(config)
    used = [key for key in own if has_effect(config, key)]
    learned_from = [key for key in used if key.startswith(("env.", "algo.")) or key in ("num_envs", "total_steps")]
    assert {key: asked[key] for key in learned_from} == {key: own[key] for key in learned_from}


def test_scoring_one_does_not_write_into_the_package(capsys):
    before = zoo.open_run("zoo:walker2d-sac").gymnasium_scores.read_bytes()
    assert command_here("eval", "run=zoo:walker2d-sac", "episodes=1") == 0
    assert "Walker2d-v5: 7," in capsys.readouterr().out
    assert zoo.open_run("zoo:walker2d-sac").gymnasium_scores.read_bytes() == before


def test_the_table_and_an_unknown_name(capsys):
    done = command("zoo")
    assert done.returncode == 0 and done.stdout.count("python -m mjx_walk.train") == len(NAMES), done.stderr
    for name in ("", "../elsewhere", "/elsewhere"):
        assert command_here("zoo", "add=zoo:walker2d-sac", f"name={name}") == 2
        assert "use only letters, digits, '_' and '-'" in capsys.readouterr().err
    assert zoo.names() == NAMES
    assert command_here("eval", "run=zoo:humanoid-dqn") == 2
    assert "no policy 'humanoid-dqn' in the zoo; did you mean: zoo:humanoid-" in capsys.readouterr().err


def test_a_policy_can_be_copied_and_pickled():
    run = mjx_walk.load_run("zoo:walker2d-sac", "c")
    obs = np.random.default_rng(0).normal(size=(3, 17))
    expected = run.policy(obs)
    for policy in (pickle.loads(pickle.dumps(run.policy)), copy.deepcopy(run).policy):
        np.testing.assert_array_equal(policy(obs), expected)
