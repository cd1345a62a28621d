"""Where `xml_file` finds a model, and the files that MuJoCo reads for it."""

import copy
import os
from pathlib import Path

import gymnasium
import imageio.v3 as iio
import numpy as np
import pytest
from gymnasium.envs.mujoco.mujoco_env import expand_model_path

from mjx_walk.envs import TASKS, make_env
from mjx_walk.envs.model_files import source_hashes
from mjx_walk.envs.models import load_model
from mjx_walk.evaluation.gymnasium_scores import score_in_gymnasium
from mjx_walk.settings.config import load_config
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.episode import make_gymnasium

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


@pytest.mark.parametrize("given", ["hopper.xml", "./hopper.xml", "a/hopper.xml", "../work/hopper.xml", "~/hopper.xml"])
def test_a_name_is_looked_up_as_gymnasium_does(given, tmp_path, monkeypatch):
    """An asset's name is the asset, whatever the working directory holds; a path is never one."""
    for folder in ("work/a", "home"):
        (tmp_path / folder).mkdir(parents=True)
    for folder in ("work", "work/a", "home"):
        (tmp_path / folder / "hopper.xml").write_bytes((ASSETS / "hopper.xml").read_bytes())
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "work")
    found = make_env("hopper", physics="c", xml_file=given).gymnasium_kwargs()["xml_file"]
    expected = os.path.abspath(given) if given.startswith("a") else expand_model_path(given)
    assert os.path.isabs(found) and os.path.samefile(found, expected)


def test_the_includes_of_a_link_stand_beside_the_link(tmp_path, monkeypatch):
    """As for MuJoCo and Gymnasium: a link is not resolved."""
    (tmp_path / "linked").mkdir()
    (tmp_path / "target").mkdir()
    text = (ASSETS / "hopper.xml").read_text()
    actuator = text[text.index("<actuator>") : text.index("</actuator>") + len("</actuator>")]
    (tmp_path / "target" / "robot.xml").write_text(text.replace(actuator, '<include file="motors.xml"/>'))
    (tmp_path / "linked" / "robot.xml").symlink_to("../target/robot.xml")
    (tmp_path / "linked" / "motors.xml").write_text(f"<mujoco>{actuator}</mujoco>")
    (tmp_path / "shortcut").symlink_to("linked")
    monkeypatch.chdir(tmp_path)
    for given in (
        "linked/robot.xml",
        "./linked/../linked/robot.xml",
        "shortcut/robot.xml",
        "shortcut/../linked/robot.xml",
    ):
        options = load_config(["env=hopper", f"env.xml_file={given}", "hardware=cpu"]).env
        monkeypatch.chdir("/")
        task = TASKS["hopper"][0](options, "c")
        monkeypatch.chdir(tmp_path)
        assert task.action_size == gymnasium.make("Hopper-v5", xml_file=f"./{given}").action_space.shape[0] == 3
        assert os.path.samefile(os.path.dirname(options.xml_file), "linked")


def test_a_task_keeps_its_files_when_the_working_directory_changes(tmp_path, monkeypatch):
    (tmp_path / "mine.xml").write_bytes((ASSETS / "hopper.xml").read_bytes())
    (tmp_path / "reward.py").write_text("def reward(step):\n    return step.terms\n")
    monkeypatch.chdir(tmp_path)
    options = TASKS["hopper"][1](name="hopper", xml_file="./mine.xml", reward_function="reward.py:reward")
    task = TASKS["hopper"][0](options, "c")
    env = gymnasium.make("mjx_walk/Hopper-v5", physics="c", xml_file="mine.xml")
    monkeypatch.chdir("/")
    assert copy.deepcopy(task).gymnasium_kwargs() == {"xml_file": str(tmp_path / "mine.xml")}
    assert env.reset(seed=0)[0].shape == (11,)


def needed_files(folder):
    """The files of a folder without which MuJoCo cannot read the folder's `robot.xml`."""
    needed = set()
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        content = path.read_bytes()
        path.unlink()
        try:
            load_model(str(folder / "robot.xml"))
        except UserError:
            needed.add(str(path.relative_to(folder)))
        path.write_bytes(content)
    return needed


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BODY = '<worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody>'
ODD = {
    "backslashes": (
        f'<mujoco><compiler meshdir="d\\q"/><include file="a\\b.xml"/>{BODY}</mujoco>',
        {"a/b.xml": '<mujoco><asset><mesh name="m" file="r\\m.obj"/></asset></mujoco>', "d/q/r/m.obj": TETRAHEDRON},
    ),
    "later assetdir": (
        '<mujoco><compiler meshdir="q"/><compiler assetdir="d"/><asset><mesh name="m" file="m.obj"/></asset>'
        f"{BODY}</mujoco>",
        {"q/m.obj": "not read", "d/m.obj": TETRAHEDRON},
    ),
    "comment sign in a name": (
        f'<mujoco model="<!--"><include file="b.xml"/>{BODY}<!-- --></mujoco>',
        {"b.xml": '<mujoco><asset><mesh name="m" file="m.obj"/></asset></mujoco>', "m.obj": TETRAHEDRON},
    ),
    "references": (
        f'<mujoco><include file="a&amp;b&#x63;.xml"/>{BODY}</mujoco>',
        {"a&bc.xml": '<mujoco><asset><mesh name="m" file="m&copy.obj"/></asset></mujoco>', "m&copy.obj": TETRAHEDRON},
    ),
    "text and declarations": (
        '<mujoco><!ELEMENT <include file="x.xml"/>><![CDATA[<include file="x.xml"/>]]><include file="b.xml"/>'
        f"{BODY}</mujoco>",
        {
            "b.xml": '<mujoco><asset><mesh name="m" file="m.obj"/></asset></mujoco>',
            "m.obj": TETRAHEDRON,
            "x.xml": "<mujoco/>",
        },
    ),
    "urdf": (
        '<robot name="r"><mujoco><compiler strippath="false"/></mujoco><link name="base"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>'
        '<mesh filename="q/m.obj"/></geometry></collision></link><link name="arm"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="j" type="continuous"><parent link="base"/><child link="arm"/></joint></robot>',
        {"q/m.obj": TETRAHEDRON, "m.obj": "not read"},
    ),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_names_of_files_are_sources(name, tmp_path):
    text, files = ODD[name]
    for path, content in {"robot.xml": text, **files}.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(content)
    assert source_hashes(str(tmp_path / "robot.xml")).keys() == needed_files(tmp_path)
    assert len(needed_files(tmp_path)) >= 2


@pytest.fixture
def robot(tmp_path):
    """A model of several files: nested includes, assets in the compiler's folders, and a submodel with its own."""
    texts = {
        "robot.xml": (
            '<mujoco><!-- <include file="unused.xml"/> --><compiler meshdir="./meshes" texturedir="pictures"/>'
            '<include file="parts/body.xml"/><asset><model name="arm" file="arm/arm.xml"/></asset></mujoco>'
        ),
        "parts/body.xml": (
            '<mujoco><include file="assets.xml"/><worldbody><body><joint/><geom type="mesh" mesh="torso"/></body>'
            '<frame><attach model="arm" body="upper" prefix="arm_"/></frame></worldbody></mujoco>'
        ),
        "parts/assets.xml": (
            "<mujoco><asset><mesh name='torso' file='torso.obj'/><texture name='skin' type='2d' file='skin.png'/>"
            '<hfield name="ground" file="ground.png" size="1 1 1 1"/></asset></mujoco>'
        ),
        "meshes/torso.obj": TETRAHEDRON,
        "arm/arm.xml": (
            '<mujoco><compiler assetdir="."/><asset><mesh name="hand" file="hand.obj"/></asset><worldbody>'
            '<body name="upper"><joint/><geom type="mesh" mesh="hand"/></body></worldbody></mujoco>'
        ),
        "arm/hand.obj": TETRAHEDRON,
        "unused.xml": "<mujoco/>",
        "torso.obj": "not read",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    picture = np.zeros((4, 4, 3), np.uint8)
    for name in ("pictures/skin.png", "parts/ground.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        iio.imwrite(tmp_path / name, picture)
    return tmp_path


def test_every_file_that_mujoco_reads_is_a_source(robot):
    """A file is a source exactly if MuJoCo cannot read the model without it."""
    model = str(robot / "robot.xml")
    load_model(model)
    found = source_hashes(model)
    needed = needed_files(robot)
    assert found.keys() == needed and len(needed) == 8
    for name in needed:
        content = (robot / name).read_bytes()
        (robot / name).write_bytes(content + b" ")
        assert {key for key, value in source_hashes(model).items() if found[key] != value} == {name}
        (robot / name).write_bytes(content)
    assert source_hashes(model) == found
    assert source_hashes("ant.xml").keys() == {"ant.xml"}


def test_gymnasium_that_reads_another_model_than_the_task_is_reported(tmp_path, caplog):
    path = tmp_path / "pole.xml"
    path.write_bytes((ASSETS / "inverted_pendulum.xml").read_bytes())
    task = make_env("inverted_pendulum", "c", xml_file=str(path))
    make_gymnasium(task).close()
    assert not caplog.records
    path.write_text(path.read_text().replace("-9.81", "-9"))
    make_gymnasium(task).close()
    assert f"{path} has changed since it was loaded; it is used as it is now" in caplog.text
    path.unlink()
    for reads_it in (make_gymnasium, lambda task: score_in_gymnasium(task, lambda obs: obs[:, :1], 1)):
        with pytest.raises(UserError, match="is gone, and Gymnasium reads it again; restore it"):
            reads_it(task)
