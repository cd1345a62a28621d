"""Runs on environments of other libraries: training, resume, loading, scores and commands."""

import copy
import json
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
from brax.envs.fast import Fast
from helpers import (
    ENVIRONMENT,
    ON_POLICY,
    blocks,
    command,
    command_here,
    leaves,
    small_settings,
    unregistered,
    used_settings,
)

import mjx_walk
from mjx_walk.algos import ALGORITHMS
from mjx_walk.utils.errors import UserError

SLOW, LONG = pytest.mark.slow, (pytest.mark.slow, pytest.mark.long)
OTHERS = [pytest.param(algo, marks=LONG) for algo in ALGORITHMS if algo not in ("ppo", "csac")]
"""Algorithms whose resumes `training/test_resume.py` covers, on tasks of this package."""
SETTINGS = ("num_envs=8", "evaluation.num_envs=2", "evaluation.gymnasium_episodes=0", "checkpoint.every_calls=2")
FILE = """
import mjx_walk
from brax.envs.fast import Fast

Task = mjx_walk.from_brax(Fast(), episode_length=20)
"""


@pytest.fixture(autouse=True)
def _no_curves(monkeypatch):
    """They would take a quarter of the time."""
    monkeypatch.setattr("mjx_walk.viewing.run_plots.plot_run", lambda folder: None)


def small(algo):
    """Settings of a call of 64 steps."""
    length = {"unroll_length": 8} if algo in ON_POLICY else {"unroll_length": 1}
    changed = {key: value for key, value in small_settings(algo, **length).items() if key in used_settings(algo)}
    texts = {key: json.dumps(value).replace(" ", "") for key, value in changed.items()}
    calls = f"iterations_per_call={1 if algo in ON_POLICY else 8}"
    return [*SETTINGS, calls, f"algo={algo}", *(f"algo.{name}={text}" for name, text in texts.items())]


@pytest.mark.filterwarnings("ignore:.*changes the run's length")
@pytest.mark.parametrize("algo", ["ppo", pytest.param("csac", marks=SLOW), *OTHERS])
def test_a_resumed_training_equals_one_that_never_stopped(algo, tmp_path):
    task = mjx_walk.from_brax(Fast(), episode_length=20)
    with unregistered():
        whole, part = tmp_path / "whole", tmp_path / "part"
        mjx_walk.run([*small(algo), "total_steps=256", f"run_dir={whole}"], task=task)
        mjx_walk.run([*small(algo), "total_steps=128", "algo.schedule_steps=256", f"run_dir={part}"], task=task)
        mjx_walk.run([f"run_dir={part}", "resume=true", "total_steps=256"], task=task)
    expected, found = leaves(whole, 4), leaves(part, 4)
    assert expected.keys() == found.keys() and any("xd.vel" in name for name in found)
    for name, leaf in expected.items():
        np.testing.assert_array_equal(found[name], leaf, err_msg=name)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run that was trained from Python."""
    run_dir = tmp_path_factory.mktemp("runs") / "fast"
    with unregistered():
        run = mjx_walk.run([*small("ppo"), "total_steps=64", f"run_dir={run_dir}"], task=mjx_walk.from_brax(Fast(), 20))
        assert run.config.env.name == "brax_fast" and run.config.env.max_episode_steps == 20
        assert run.config.physics == "auto"
    return run_dir


def test_a_run_is_loaded_and_scored(trained):
    with unregistered():
        run = mjx_walk.load_run(trained, task=mjx_walk.from_brax(Fast(), 20))
        scores = run.evaluate(3)
        assert scores.env == "brax_fast on brax" and list(scores.lengths) == [20, 20, 20]
        pickled = pickle.dumps(run)
        for other in (copy.deepcopy(run), pickle.loads(pickled)):
            assert other.policy(np.zeros(2)) == run.policy(np.zeros(2)) and other.config == run.config
        with pytest.raises(UserError, match="brax_fast is simulated by brax: physics=, films, play and export are for"):
            mjx_walk.load_run(trained, physics="c")
        with pytest.raises(UserError, match="brax_fast is simulated by brax"):
            mjx_walk.make_env("brax_fast")
    for load in (lambda: mjx_walk.load_run(trained), lambda: pickle.loads(pickled)):
        with unregistered(), pytest.raises(UserError) as error:
            load()
        says = "pass task=CLASS to run or load_run, or call mjx_walk.register_task first"
        assert "'brax_fast'" in str(error.value) and says in str(error.value)


def test_commands_take_the_task_from_a_file(trained, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_task.py").write_text(FILE)
    with unregistered():
        assert command_here("eval", f"run={trained}", "episodes=2") == 2
        assert "the task 'brax_fast'" in capsys.readouterr().err
        assert command_here("eval", f"run={trained}", "episodes=2", "env.task=my_task.py:Task") == 0
        assert "brax_fast on brax" in capsys.readouterr().out
        for name in ("play", "export"):
            assert command_here(name, f"run={trained}", "env.task=my_task.py:Task") == 2
            error = capsys.readouterr().err
            assert "brax_fast is simulated by brax" in error and error.count("\n") == 1
        films = ("evaluation.films=true", "env.task=my_task.py:Task", f"run_dir={tmp_path / 'new'}")
        assert command_here("train", *films) == 2
        assert "brax_fast is simulated by brax" in capsys.readouterr().err and not (tmp_path / "new").exists()


@pytest.mark.slow
def test_a_training_by_command_is_resumed_and_scored_without_its_file(tmp_path, monkeypatch, capsys):
    """The resume is in a process of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_task.py").write_text(FILE)
    end = "To load the best policy: mjx_walk.load_run('run', task=…)"
    with unregistered():
        named = ("env.task=my_task.py:Task", "total_steps=64", "run_dir=run")
        assert command_here("train", *small("a2c"), *named) == 0
        assert end in "".join(capsys.readouterr())
    done = command("train", "run_dir=run", "resume=true", "total_steps=128", cwd=tmp_path)
    assert done.returncode == 0 and end in done.stdout + done.stderr, done.stderr
    with unregistered():
        assert command_here("eval", "run=run", "episodes=2") == 0
        assert "brax_fast on brax" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.long
def test_ppo_learns_to_balance_braxs_pole(tmp_path):
    """The program of the documentation. CI traces it, and trains on an environment of gymnax."""
    (example,) = [block for block in blocks("python") if block.startswith("# brax_pendulum.py")]
    program = [sys.executable, "-c", example]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, env=ENVIRONMENT, check=True)
    found = re.search(r"brax_inverted_pendulum on brax: ([0-9.]+) ±", done.stdout)
    assert float(found[1]) > 150, done.stdout


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.frame_skip=2", "brax_fast does not take env.frame_skip; it takes env.max_episode_steps"),
        ("env.max_episode_steps=0", "env.max_episode_steps=0: must be at least 1"),
        ("physics=jax", "simulated by brax: physics="),
    ],
)
def test_settings_that_do_not_fit(override, message, tmp_path):
    with unregistered(), pytest.raises(UserError) as error:
        mjx_walk.run([*small("ppo"), override, f"run_dir={tmp_path / 'run'}"], task=mjx_walk.from_brax(Fast()))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_an_environment_in_place_of_a_class():
    with pytest.raises(UserError, match=r"object of the class Fast: give a class; .* mjx_walk.from_brax\(env\)"):
        mjx_walk.run(task=Fast())
