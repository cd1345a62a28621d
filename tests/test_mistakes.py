"""Plausible mistakes: each gets one line that says what to do, and exit code 2, and leaves no file behind.

The files of `mistakes/` hold a mistake in a line, and below it, indented, the error.
"""

import importlib
import shlex
import shutil
import sys
from pathlib import Path

import gymnasium
import pytest
from helpers import OLD_RUNS, renders

import mjx_walk
from mjx_walk import compare, play, zoo
from mjx_walk.algos import ALGORITHMS
from mjx_walk.cli import parsing
from mjx_walk.envs import GYMNASIUM_TASKS, TASKS
from mjx_walk.experiments import slots
from mjx_walk.settings.config import load_config
from mjx_walk.training import launcher
from mjx_walk.utils.errors import UserError

TABLES = Path(__file__).parent / "mistakes"
MODEL = '<mujoco><worldbody><body name="torso">{}<geom size="0.1"/></body></worldbody></mujoco>\n'
SLIDES = '<joint type="slide"/><joint type="slide" axis="0 1 0"/><joint axis="0 1 0"/>'
LISTS = {
    "envs": ", ".join(TASKS),
    "gymnasium_envs": ", ".join(GYMNASIUM_TASKS),
    "algos": ", ".join(ALGORITHMS),
    "algos_with_minibatches": ", ".join(n for n, (_, c) in ALGORITHMS.items() if hasattr(c, "num_minibatches")),
    "envs_with_contact_cost": ", ".join(n for n, (_, c) in TASKS.items() if hasattr(c, "contact_cost_weight")),
    "policies": ", ".join(zoo.names()),
}
NAMES = {
    name: getattr(mjx_walk, name) for name in ("BraxEnv", "GymnaxEnv", "load_run", "make_env", "register_task", "run")
}


def read(table):
    """Mistakes and their messages. The lines of a message are joined by spaces."""
    pairs = []
    for line in (TABLES / table).read_text(encoding="utf-8").splitlines():
        if line.startswith("    "):
            pairs[-1][1].append(line.strip())
        else:
            pairs.append((line, []))
    return [pytest.param(mistake, " ".join(lines), id=mistake) for mistake, lines in pairs]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with runs, models and Python files, some of them defective."""
    path = tmp_path_factory.mktemp("work")
    shutil.copytree(OLD_RUNS / "ppo", path / "run")
    shutil.copytree(OLD_RUNS / "ppo", path / "runs" / "2026-01-01")
    config = (path / "run" / "config.yaml").read_text()
    for name, text in (("broken", "env: [walker2d\nalgo: ppo\n"), ("empty", ""), ("untrained", config)):
        (path / name).mkdir()
        (path / name / "config.yaml").write_text(text)
    (path / "no_joints.xml").write_text(MODEL.format(""))
    (path / "no_motors.xml").write_text(MODEL.format(SLIDES))
    (path / "attribute.xml").write_text(MODEL.format('\n<joint kind="slide"/>'))
    (path / "unclosed.xml").write_text("<mujoco>\n<worldbody>\n</mujoco>\n")
    for name in ("text.txt", "text.xml"):
        (path / name).write_text("some text\n")
    (path / "reward.py").write_text("def speed(step):\n    return {}\n")
    (path / "raises.py").write_text("import no_such_module\n")
    return path


@pytest.fixture
def files(folder, monkeypatch):
    """Makes the folder the working directory, and checks that nothing in it is added or lost."""
    monkeypatch.chdir(folder)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for module in (launcher, slots):  # asks another process
        monkeypatch.setattr(module, "count_devices", lambda: ("cpu", 1))
    before = sorted(folder.rglob("*"))
    yield folder
    assert sorted(folder.rglob("*")) == before


def check_line(module, arguments, message, monkeypatch, capsys):
    main = importlib.import_module(f"mjx_walk.{module}").main
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with pytest.raises(SystemExit) as ended:
        parsing.main(main)
    captured = capsys.readouterr()
    assert captured.err == f"error: {message}\n" and captured.out == ""
    assert ended.value.code == 2


@pytest.mark.parametrize(("arguments", "message"), read("train.txt"))
def test_training(arguments, message, files, monkeypatch, capsys):
    check_line("train", shlex.split(arguments), message.format(here=files, **LISTS), monkeypatch, capsys)


@pytest.mark.parametrize(("command_line", "message"), read("commands.txt"))
def test_other_commands(command_line, message, files, monkeypatch, capsys):
    command, *arguments = shlex.split(command_line)
    module = "zoo.__main__" if command == "zoo" else command
    check_line(module, arguments, message.format(here=files, **LISTS), monkeypatch, capsys)


@pytest.mark.parametrize(("expression", "message"), read("api.txt"))
def test_python(expression, message, files):
    with pytest.raises(UserError) as error:
        eval(expression, {"gymnasium": gymnasium, **NAMES})
    assert str(error.value) == message.format(**LISTS)


@renders
def test_a_strip_past_the_end_of_the_episode(files, monkeypatch, capsys):
    message = "start=1000 is past the end of the episode, which lasts 0.02 s; give a smaller one"
    check_line("play", ["run=run", "strip=strip.png", "start=1000"], message, monkeypatch, capsys)


def test_a_strip_begins_earlier_in_a_short_episode():
    assert play._shown(play.Arguments(), 20.0) == (5.0, 1.0)
    assert play._shown(play.Arguments(), 3.0) == (2.0, 1.0)
    assert play._shown(play.Arguments(seconds=2.0), 0.5) == (0.0, 2.0)
    assert play._shown(play.Arguments(start=0.25), 0.5) == (0.25, 1.0)


def test_there_are_many():
    assert sum(len(read(path.name)) for path in TABLES.iterdir()) > 200


def test_whole_numbers_are_integers():
    config = load_config(["total_steps=1e5", "num_envs=64.0", "seed=1e1", "algo.num_epochs=1_0e0"])
    assert (config.total_steps, config.num_envs, config.seed, config.algo.num_epochs) == (100_000, 64, 10, 10)
    assert parsing.parse(compare.Arguments, ["together=2.0"], "").together == 2
