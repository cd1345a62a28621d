"""Runs of a user's own task: trained, loaded, scored and resumed; a stranger's file never runs unnamed."""

import pickle
import shutil

import pytest
from helpers import TINY, TINY_CALL, command_here, train_here, unregistered

import mjx_walk
from mjx_walk.envs import TASKS, registry
from mjx_walk.envs.walker2d import Walker2d
from mjx_walk.settings.config import load_config
from mjx_walk.settings.saved_config import read_config, save_config
from mjx_walk.utils.errors import UserError

TASK = """
import pathlib
pathlib.Path({ran!r}).touch()
from my_helper import FACTOR
from mjx_walk.envs.walker2d import Walker2d

class FastWalker(Walker2d):
    def reward_and_termination(self, *step):
        terms, reward, terminated = super().reward_and_termination(*step)
        return terms, FACTOR * reward, terminated
"""
OWN = TINY[1:]


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A user's home, with a task file in the working directory."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    write_task(tmp_path / "work", tmp_path / "ran")
    monkeypatch.chdir(tmp_path / "work")
    with unregistered():
        yield tmp_path


def write_task(folder, ran):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "t.py").write_text(TASK.format(ran=str(ran)))
    (folder / "my_helper.py").write_text("FACTOR = 2.0\n")


def refused(capsys, module, *arguments):
    """The one line with which a command refuses."""
    capsys.readouterr()
    assert command_here(module, *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def train_from_file(run_dir, *arguments):
    train_here(run_dir, "env.task=t.py:FastWalker", f"total_steps={TINY_CALL}", *arguments, tiny=OWN)


def as_in_a_new_process(name="fast_walker"):
    """Forget the task, as another process would."""
    TASKS.pop(name)
    registry._files.pop(name, None)


def test_a_task_from_a_file_needs_no_name_later(home, capsys):
    train_from_file("run", "env.healthy_reward=0.5")
    config = read_config(home / "work" / "run" / "config.yaml")
    assert (config.env.name, config.env.healthy_reward) == ("fast_walker", 0.5)
    assert config.env.task == f"{home}/work/t.py:FastWalker" and config.total_steps == TINY_CALL
    pickled = pickle.dumps(mjx_walk.load_run("run"))
    as_in_a_new_process()
    (home / "ran").unlink()
    assert pickle.loads(pickled).config.env.healthy_reward == 0.5 and (home / "ran").exists()
    as_in_a_new_process()
    (home / "ran").unlink()
    assert command_here("eval", "run=run", "episodes=1") == 0
    assert "fast_walker on c" in capsys.readouterr().out and (home / "ran").exists()


def test_the_file_runs_only_if_the_user_has_named_it(home, monkeypatch, capsys):
    """One run, seen by another user, after a change of the file, and after a move."""
    train_from_file("run")
    as_in_a_new_process()
    (home / "ran").unlink()
    named = f"env.task={home}/work/t.py:FastWalker"
    with monkeypatch.context() as patched:
        patched.setenv("XDG_CONFIG_HOME", str(home / "another_user"))
        expected = f"error: the saved run uses the code of {named.removeprefix('env.task=')}; to run it, add {named}"
        for module in ("eval", "play", "export"):
            assert refused(capsys, module, "run=run") == expected
        assert named in refused(capsys, "train", "run_dir=run", "resume=true", f"total_steps={2 * TINY_CALL}")
    (home / "work" / "my_helper.py").write_text("FACTOR = 3.0\n")
    line = refused(capsys, "eval", "run=run", "episodes=1")
    assert "my_helper.py has changed since you named it" in line and named in line
    shutil.move(home / "work", home / "moved")
    run = str(home / "moved" / "run")
    assert named in refused(capsys, "eval", f"run={run}")
    assert not (home / "ran").exists()
    moved = f"env.task={home}/moved/t.py:FastWalker"
    assert command_here("eval", f"run={run}", "episodes=1", moved) == 0
    train_here(run, "resume=true", f"total_steps={2 * TINY_CALL}", moved, tiny=[])
    assert (home / "ran").exists()


def test_a_class_from_python(home, capsys):
    class LazyWalker(Walker2d):
        pass

    run = mjx_walk.run([*OWN, "run_dir=run", f"total_steps={TINY_CALL}"], task=LazyWalker)
    assert run.config.env.name == "lazy_walker" and run.evaluate(episodes=1).env == "lazy_walker on c"
    pickled = pickle.dumps(run)
    assert pickle.loads(pickled).config == run.config
    as_in_a_new_process("lazy_walker")
    with pytest.raises(UserError, match=r"or call mjx_walk\.register_task first"):
        pickle.loads(pickled)
    line = refused(capsys, "eval", "run=run")
    assert line.startswith("error: the task 'lazy_walker' of run/config.yaml is not registered; add env.")
    assert mjx_walk.load_run("run", task=LazyWalker).task.observation_size == 17
    (home / "work" / "t.py").write_text(TASK.format(ran="ran").replace("FastWalker", "LazyWalker"))
    as_in_a_new_process("lazy_walker")
    train_here("run", "resume=true", f"total_steps={TINY_CALL}", "env.task=t.py:LazyWalker", tiny=[])
    as_in_a_new_process("lazy_walker")
    with pytest.raises(UserError, match="give task= or env=ant, not both"):
        mjx_walk.run(["env=ant"], task=LazyWalker)
    with pytest.raises(UserError, match=r"evaluation.films=true films in another process; name the task as env.task="):
        mjx_walk.run([*OWN, "evaluation.films=true"], task=LazyWalker)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["env.task=t.py:FastWalker", "env=ant"], "give env=ant or env.task=.*, not both"),
        (["env.task=none.py:FastWalker"], "no file .*none.py'; write PATH.py:CLASS"),
        (["env.task=t.py:Slow"], "has no class 'Slow'"),
        (["env.task=my_helper.py:FACTOR"], "has no class 'FACTOR'"),
        (["env.task=t.py:pathlib"], "has no class 'pathlib'"),
        (["env.task=t.py"], "it names no class; write t.py:CLASS; it defines: FastWalker"),
        (["env.task=t.py:FastWalker", "env.speed=1"], "unknown key 'env.speed'"),
    ],
)
def test_mistakes(overrides, says):
    with pytest.raises(UserError, match=says):
        load_config(overrides)


def test_a_file_for_a_task_of_this_package_is_refused(home):
    path = home / "work" / "config.yaml"
    save_config(load_config(["env=walker2d"]), path)
    path.write_text(path.read_text().replace("  task: null", f"  task: {home}/work/t.py:FastWalker"))
    with pytest.raises(UserError, match=r"sets env\.task for 'walker2d', a task of this package"):
        read_config(path)
    assert not (home / "ran").exists()
