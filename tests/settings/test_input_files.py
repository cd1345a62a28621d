"""A run whose model, reward function or task has changed since its training."""

import hashlib
import json
import shutil
import warnings
from pathlib import Path

import gymnasium
import pytest
from helpers import OLD_RUNS, TINY, TINY_CALL, command_here, train_here

import mjx_walk
from mjx_walk import api
from mjx_walk.experiments.planned_runs import plan
from mjx_walk.utils.errors import UserError

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
SETTINGS = [*TINY[1:], f"total_steps={TINY_CALL}"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run on a model that includes another file, with a reward function."""
    home = tmp_path_factory.mktemp("home")
    text = (ASSETS / "walker2d_v5.xml").read_text()
    motors = text[text.index("<actuator>") : text.index("</actuator>") + len("</actuator>")]
    (home / "robot.xml").write_text(text.replace(motors, '<include file="motors.xml"/>'))
    (home / "motors.xml").write_text(f"<mujoco>{motors}</mujoco>")
    (home / "reward.py").write_text("def reward(step):\n    return step.terms\n")
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(home)
        patched.setenv("XDG_CONFIG_HOME", str(home / "config"))
        named = ("env.xml_file=robot.xml", "env.reward_function=reward.py:reward")
        train_here("run", "env=walker2d", *named, tiny=SETTINGS)
    return home


@pytest.fixture
def home(trained, tmp_path, monkeypatch):
    """The same in a fresh folder, where the files may change; the paths of the run are those of this folder."""
    shutil.copytree(trained, tmp_path / "home")
    home = tmp_path / "home"
    for path in (*home.rglob("config.yaml"), *home.rglob("trusted*.json")):
        path.write_text(path.read_text().replace(str(trained), str(home)))
    for path in home.glob("run/checkpoints/*/config.yaml"):
        path.unlink()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home / "config"))
    monkeypatch.chdir(home)
    return home


def change(path):
    path.write_text(path.read_text() + "\n")


def refused(capsys, *arguments):
    capsys.readouterr()
    assert command_here("train", "run_dir=run", "resume=true", *arguments) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    return line


def test_a_changed_model_is_refused_at_a_resume_and_named_by_a_player(home, capsys):
    """Also an included file, a run folder that has moved, and until the file is as it was."""
    original = (home / "motors.xml").read_text()
    mjx_walk.load_run("run")
    change(home / "motors.xml")
    says = f"error: {home}/motors.xml has changed since run was trained; to continue with it as it is now, add "
    assert refused(capsys) == says + f"env.xml_file={home}/robot.xml"
    assert refused(capsys, "seed=0") == says + f"env.xml_file={home}/robot.xml"
    other = refused(capsys, "env=walker2d", *SETTINGS)
    assert "run was trained with other settings: " in other and "env.xml_file (was " in other
    shutil.move("run", "elsewhere")
    with pytest.warns(UserWarning, match=f"{home}/motors.xml has changed since elsewhere was trained; it is used"):
        mjx_walk.load_run("elsewhere")
    shutil.move("elsewhere", "run")
    (home / "motors.xml").write_text(original)
    mjx_walk.load_run("run")


@pytest.mark.slow  # two trainings
def test_a_model_that_is_named_again_is_the_model_of_the_run(home):
    """Also from the folder to which it has moved."""
    (home / "moved").mkdir()
    for name in ("robot.xml", "motors.xml"):
        shutil.move(home / name, home / "moved" / name)
    named = ["run_dir=run", "resume=true", "env.xml_file=moved/robot.xml"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mjx_walk.run([*named, f"total_steps={2 * TINY_CALL}"])
    assert not [warning for warning in caught if "has changed since" in str(warning.message)]
    change(home / "moved" / "motors.xml")
    with pytest.warns(UserWarning, match="it continues with it"):
        mjx_walk.run([*named, f"total_steps={3 * TINY_CALL}"])
    assert api.resolve(["run_dir=run", "resume=true"]).env.xml_file == f"{home}/moved/robot.xml"  # it is recorded


def test_a_reward_that_another_run_has_named_is_refused(home, capsys):
    """The user trusts the changed file, and this run was still trained with another one."""
    change(home / "reward.py")
    path = home / "config" / "mjx_walk" / "trusted_reward_functions.json"
    trusted = json.loads(path.read_text())
    digest = hashlib.sha256((home / "reward.py").read_bytes()).hexdigest()
    path.write_text(json.dumps({source: dict.fromkeys(files, digest) for source, files in trusted.items()}))
    line = refused(capsys)
    assert f"{home}/reward.py has changed since run was trained" in line
    assert line.endswith(f"add env.reward_function={home}/reward.py:reward")
    mjx_walk.load_run("run")  # which does not run it


def test_a_model_that_is_gone_is_named(home, capsys):
    (home / "moved").mkdir()
    for name in ("robot.xml", "motors.xml"):
        shutil.move(home / name, home / "moved" / name)
    assert refused(capsys).startswith(
        f"error: model file not found: {home}/robot.xml; restore it, or add env.xml_file="
    )
    with pytest.raises(UserError, match=r"robot\.xml; restore it, or correct env.xml_file in run/config\.yaml"):
        mjx_walk.load_run("run")


def test_a_comparison_does_not_mix_models(home):
    named = ("env.xml_file=robot.xml", "env.reward_function=reward.py:reward")
    options = (["env=walker2d", *SETTINGS, *named], ["ppo"], [0], "out", "cpu")
    _, (run,) = plan(*options)
    shutil.copytree("run", run.folder.path)
    plan(*options)
    change(home / "motors.xml")
    with pytest.raises(UserError, match=r"motors\.xml has changed since out/ppo/seed_0 was trained"):
        plan(*options)


def test_a_run_without_a_record_loads_as_before_and_a_damaged_record_is_named(home, recwarn):
    change(home / "robot.xml")
    record = home / "run" / "inputs.json"
    text = record.read_text()
    record.unlink()
    mjx_walk.load_run("run")
    mjx_walk.load_run(OLD_RUNS / "ppo")
    assert not [warning for warning in recwarn if "changed" in str(warning.message)]
    for damaged in (text[:-9], "[]", text.replace(json.loads(text)["sha256"]["env.xml_file"]["robot.xml"], "0")):
        record.write_text(damaged)
        with pytest.warns(UserWarning, match=r"run/inputs\.json is damaged"):
            mjx_walk.load_run("run")
