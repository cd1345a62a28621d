"""Reward shaping, term by term against its definition, and custom reward functions."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TINY_CALL, command_here, train_here

from mjx_walk import api
from mjx_walk.envs import make_env
from mjx_walk.envs.reward_shaping import Shaping
from mjx_walk.utils.errors import UserError

CUSTOM_REWARD = """
import jax.numpy as jnp

def upright(step):
    height = step.after.qpos[1]
    return {"reward_height": 2.0 * height, "reward_forward": step.terms["reward_forward"]}

def broken(step):
    return step.after.qpos[99] + missing

def length(step):
    return {"length": step.reward}

def falling(step):
    return {"reward_falling": step.reward * (step.dt < 1)}

def vector(step):
    return {"reward_all": step.after.qpos}
"""


@pytest.fixture
def custom(tmp_path):
    path = tmp_path / "my_reward.py"
    path.write_text(CUSTOM_REWARD)
    return path


def step(task, qpos_change, qvel, action=0.3):
    """The states before and after one step from the model's pose with some positions changed."""
    qpos = task.init_qpos + jnp.zeros_like(task.init_qpos).at[jnp.array(list(qpos_change))].set(
        jnp.array(list(qpos_change.values()))
    )
    before = task.reset_to(qpos, jnp.full(task.init_qvel.shape, qvel))
    return before, jax.jit(task.step)(before, jnp.full(task.action_size, action))


def test_shaping_terms_equal_their_definitions():
    weights = {"keep_y": 2.0, "shaking": 0.5, "falling": 7.0, "backward": 3.0}
    plain = make_env("humanoid", physics="c")
    shaped = make_env("humanoid", physics="c", shaping=Shaping(**weights))
    assert shaped.reward_terms[-4:] == ("reward_keep_y", "reward_shaking", "reward_falling", "reward_backward")
    assert shaped.gymnasium_kwargs() == {}
    fell = 0
    for change, speed in (({1: 0.8}, 0.5), ({1: -1.2}, -2.0), ({2: -0.7}, -0.1)):
        before, after = step(shaped, change, speed)
        _, gymnasiums = step(plain, change, speed)
        qpos, qvel = np.asarray(after.physics.qpos), np.asarray(after.physics.qvel)
        moved = (qpos[0] - float(before.physics.qpos[0])) / plain.dt
        fell += int(after.terminated)
        expected = {
            "reward_keep_y": 2.0 * np.exp(-(qpos[1] ** 2)),
            "reward_shaking": -0.5 * np.mean(qvel[6:] ** 2),
            "reward_falling": -7.0 * float(after.terminated),
            "reward_backward": 3.0 * min(moved, 0.0),
        }
        for name, value in expected.items():
            assert float(after.metrics[name]) == pytest.approx(value, rel=1e-4, abs=1e-4), name
        assert float(after.reward) == pytest.approx(float(gymnasiums.reward) + sum(expected.values()), rel=1e-4)
        np.testing.assert_array_equal(after.obs, gymnasiums.obs)
    assert fell == 1


def test_shaking_counts_the_joints_with_a_motor():
    """Reacher's target and Pusher's object have none, and InvertedPendulum's motor is on its first joint."""
    for name, motors in (("reacher", [0, 1]), ("pusher", range(7)), ("inverted_pendulum", [0]), ("ant", range(6, 14))):
        task = make_env(name, physics="c", shaping=Shaping(shaking=0.5))
        _, after = step(task, {0: 0.1}, 0.7)
        expected = -0.5 * np.mean(np.asarray(after.physics.qvel)[list(motors)] ** 2)
        assert float(after.metrics["reward_shaking"]) == pytest.approx(expected, rel=1e-5), name


def test_zero_weights_add_no_terms():
    assert make_env("walker2d", physics="c").reward_terms == ("reward_forward", "reward_ctrl", "reward_survive")


def test_custom_reward_replaces_gymnasiums(custom):
    task = make_env("walker2d", physics="c", reward_function=f"{custom}:upright", shaping=Shaping(shaking=0.1))
    assert set(task.reward_terms) == {"reward_height", "reward_forward", "reward_shaking"}
    _, after = step(task, {1: 0.2}, 0.3)
    assert float(after.metrics["reward_height"]) == pytest.approx(2.0 * float(after.physics.qpos[1]), rel=1e-6)
    assert float(after.reward) == pytest.approx(sum(float(after.metrics[name]) for name in task.reward_terms), rel=1e-5)


@pytest.mark.slow
def test_policy_trained_on_a_custom_reward_is_scored_by_gymnasium(custom, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = api.run(
        [
            *("env=walker2d", "env.reward_function=my_reward.py:upright", "env.shaping.falling=5", "run_dir=run"),
            *("num_envs=8", "total_steps=512", "algo.unroll_length=32", "algo.num_minibatches=2"),
            *("evaluation.num_envs=2", "evaluation.gymnasium_episodes=1"),
        ]
    )
    row = run.metrics[-1]
    assert row["episode/reward_height"] > 0 and row["episode/reward_falling"] == -5.0
    assert row["episode/return"] == pytest.approx(
        row["episode/reward_height"] + row["episode/reward_forward"] + row["episode/reward_falling"], rel=1e-4
    )
    assert json.loads((tmp_path / "run" / "eval_gymnasium.json").read_text())["env"] == "Walker2d-v5"
    custom.unlink()  # loading and scoring the policy do not need it
    assert api.load_run("run").evaluate(1).env == "Walker2d-v5"


def test_a_run_folder_alone_runs_no_code(tmp_path, monkeypatch, capsys):
    """As a stranger's folder whose configuration names a file with code."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stranger.py").write_text(
        "import pathlib\npathlib.Path('ran').touch()\ndef reward(step):\n    return step.terms\n"
    )
    named = f"env.reward_function={tmp_path}/stranger.py:reward"
    train_here("run", f"total_steps={TINY_CALL}", "evaluation.gymnasium_episodes=1", named)
    (tmp_path / "ran").unlink()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "another_user"))
    for command, *arguments in (
        ("eval", "run=run", "episodes=1"),
        ("eval", "run=run", "episodes=1", "backend=sim"),
        ("play", "run=run", "html=page.html"),
        ("export", "run=run", "out=policy.onnx"),
        ("plots", "run=run"),
        ("train", "run_dir=run", "resume=true", f"total_steps={2 * TINY_CALL}"),
    ):
        code, printed = command_here(command, *arguments), capsys.readouterr()
        assert not (tmp_path / "ran").exists(), command
        assert code == (2 if command == "train" else 0), printed
        if "backend=sim" in arguments:
            assert "scoring with Gymnasium's reward: the run's own" in printed.err
    assert f"to run it, add {named}" in printed.err
    train_here("run", "resume=true", f"total_steps={2 * TINY_CALL}", named, tiny=[])
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("function", "says"),
    [
        ("nowhere.py:f", "nowhere.py'; write PATH.py:FUNCTION"),
        ("upright", "write PATH.py:FUNCTION"),
        ("my_reward.py:missing", "has no function 'missing'"),
        ("my_reward.py:broken", "NameError: name 'missing' is not defined"),
        ("my_reward.py:vector", "must return a dict of scalars by name"),
        ("my_reward.py:length", "the term's name 'length' must begin with reward_"),
        ("my_reward.py:falling", "env.shaping already has the term 'reward_falling'"),
    ],
)
def test_invalid_reward_function_is_refused(custom, tmp_path, monkeypatch, function, says):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        make_env("walker2d", physics="c", reward_function=function, shaping={"falling": 1.0})
    assert says in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "shaping", "says"),
    [
        ("walker2d", {"keep_y": 1.0}, "walker2d has no y coordinate; set it to 0"),
        ("hopper", {"keep_y": 1.0}, "hopper has no y coordinate; set it to 0"),
        ("reacher", {"backward": 1.0}, "reacher has no x coordinate; set it to 0"),
        ("pusher", {"falling": 1.0}, "pusher does not terminate on a fall; set it to 0"),
        ("humanoid_standup", {"falling": 1.0}, "humanoid_standup does not terminate on a fall; set it to 0"),
        ("walker2d", {"faling": 1.0}, "unknown key 'env.shaping.faling'"),
    ],
)
def test_shaping_without_effect_is_refused(name, shaping, says):
    with pytest.raises(UserError, match=says):
        make_env(name, physics="c", shaping=shaping)
