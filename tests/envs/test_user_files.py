"""Reward files and their helper modules: what is loaded, and what is left behind."""

import dataclasses
import os
import py_compile
import sys
import typing

import pytest

from mjx_walk.envs.user_files import absolute_source, changed_file, load_reward_function, only_known
from mjx_walk.utils.errors import UserError

WITH_DATACLASS = """
from __future__ import annotations
import dataclasses
import typing
import my_helper

@dataclasses.dataclass
class Weights:
    scale: float = 2.0
    kinds: typing.ClassVar[tuple] = ("dataclass",)

def reward(step):
    from my_package import deeper
    return Weights().scale * my_helper.FACTOR * deeper.BONUS

def weights(step):
    return Weights
"""


@pytest.fixture
def clean():
    """Whatever a test loads, `sys.path` and the public names in `sys.modules` stay as they were."""
    path, names, finders = list(sys.path), {*sys.modules}, list(sys.meta_path)
    yield
    assert sys.path == path and sys.meta_path == finders
    assert {name for name in {*sys.modules} - names if not name.startswith("_mjx_walk_user_file_")} == set()


def write(folder, factor=3, bonus=5):
    package = folder / "my_package"
    package.mkdir(parents=True)
    (folder / "my_reward.py").write_text(WITH_DATACLASS)
    (folder / "my_helper.py").write_text(f"FACTOR = {factor}\n")
    (package / "__init__.py").write_text("")
    (package / "deeper.py").write_text(f"from . import constants\nBONUS = constants.BONUS * {bonus}\n")
    (package / "constants.py").write_text("BONUS = 1\n")
    return f"{folder}/my_reward.py"


def test_a_dataclass_with_postponed_annotations_loads(tmp_path, clean):
    weights = load_reward_function(f"{write(tmp_path)}:weights")(None)
    assert [field.name for field in dataclasses.fields(weights)] == ["scale"]
    assert typing.get_type_hints(weights)["scale"] is float


def test_each_reward_file_takes_its_own_helpers(tmp_path, clean, monkeypatch):
    here, other = load_reward_function(f"{write(tmp_path / 'a')}:reward"), write(tmp_path / "b", factor=7, bonus=11)
    monkeypatch.chdir(tmp_path / "a")
    monkeypatch.syspath_prepend(str(tmp_path / "a"))  # as `python -m` does for the working directory
    there = load_reward_function(f"{other}:reward")
    assert [here(None), there(None), here(None)] == [30.0, 154.0, 30.0]
    assert {*here.hashes} == {
        f"{tmp_path}/a/{name}"
        for name in (
            "my_reward.py",
            "my_helper.py",
            "my_package/__init__.py",
            "my_package/deeper.py",
            "my_package/constants.py",
        )
    }


def test_a_users_own_module_of_the_same_name_is_neither_taken_nor_lost(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "my_helper.py").write_text("FACTOR = 100\n")
    import my_helper

    try:
        assert load_reward_function(f"{write(tmp_path / 'a')}:reward")(None) == 30.0
        assert sys.modules["my_helper"] is my_helper
    finally:
        del sys.modules["my_helper"]


def test_a_file_beside_does_not_replace_an_installed_module(tmp_path, clean):
    for name in ("random", "jax", "mjx_walk"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('taken')\n")
    (tmp_path / "r.py").write_text("import random, jax, mjx_walk\ndef reward(step):\n    return jax.__name__\n")
    assert load_reward_function(f"{tmp_path}/r.py:reward")(None) == "jax"


def test_a_compiled_file_is_never_run(tmp_path, clean):
    """Python would take code from `__pycache__` whose recorded time and size are those of the source."""
    source = tmp_path / "r.py"
    source.write_text("def reward(step):\n    return 'evil'\n")
    py_compile.compile(str(source))
    time = source.stat().st_mtime_ns
    source.write_text("def reward(step):\n    return 'good'\n")
    os.utime(source, ns=(time, time))
    assert load_reward_function(f"{source}:reward")(None) == "good"


@pytest.mark.parametrize("text", ["import nothing_of_this_name", "1 / 0", "import sys; sys.exit(3)", "\0", "def"])
def test_a_file_that_fails_leaves_nothing_behind(tmp_path, text):
    before = {*sys.modules}
    (tmp_path / "my_helper.py").write_text("")
    (tmp_path / "r.py").write_text(f"import my_helper\n{text}\n")
    with pytest.raises(UserError) as error:
        load_reward_function(f"{tmp_path}/r.py:reward")
    assert "\n" not in str(error.value) and {*sys.modules} == before


@pytest.mark.parametrize("name", ["my_reward.py", "my_helper.py", "my_package/constants.py"])
def test_only_the_known_files_run(tmp_path, name, clean):
    source = f"{write(tmp_path)}:reward"
    function = load_reward_function(source)
    function(None)
    known = function.hashes
    path = tmp_path / "my_reward.py"
    try:
        only_known(path, known)
        assert load_reward_function(source)(None) == 30.0 and changed_file(known) is None
        (tmp_path / name).write_text((tmp_path / name).read_text() + "# changed\n")
        assert changed_file(known) == str(tmp_path / name)
        with pytest.raises(UserError, match=f"{name} is new or has changed since you named it; to run it, add this"):
            load_reward_function(source)(None)
        only_known(path, None)
        assert load_reward_function(source)(None) == 30.0
    finally:
        only_known(path, None)


def test_helpers_that_run_later_are_hashed(tmp_path, clean):
    """So that a change of one is noticed, and a resume may run it."""
    source = write(tmp_path)
    (tmp_path / "my_helper.py").write_text(
        "def factor():\n    import my_late, my_package.constants as c, json, numpy\n"
    )
    (tmp_path / "my_late.py").write_text("import my_helper\nnot python\n")
    file = load_reward_function(f"{source}:reward")
    names = ["my_helper.py", "my_late.py", "my_package/__init__.py", "my_package/constants.py", "my_package/deeper.py"]
    assert sorted(file.hashes) == sorted(str(tmp_path / name) for name in (*names, "my_reward.py"))
    assert changed_file(file.hashes) is None
    (tmp_path / "my_late.py").write_text("")
    assert changed_file(file.hashes) == str(tmp_path / "my_late.py")


def test_helpers_elsewhere_are_hashed(tmp_path, clean, monkeypatch):
    """Folders without `__init__.py` on `sys.path`, and a folder that the file adds to it."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    source = (
        f"import sys, numpy, json\nsys.path.insert(0, '{tmp_path}/shared')\nimport my_other, my_space.deep\n"
        "def reward(step):\n    from my_space import late\n"
    )
    files = {"r.py": source, "my_space/deep.py": "", "my_space/late.py": "", "shared/my_other.py": ""}
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    try:
        hashes = load_reward_function(f"{tmp_path}/r.py:reward").hashes
    finally:
        sys.path.remove(f"{tmp_path}/shared")
        for name in ("my_other", "my_space", "my_space.deep"):
            sys.modules.pop(name, None)
    assert sorted(hashes) == sorted(str(tmp_path / name) for name in files)


def test_a_new_helper_is_not_known(tmp_path, clean):
    """It would run in place of a module that the reward file has imported from elsewhere."""
    (tmp_path / "r.py").write_text("import colorama_or_so\n\n\ndef reward(step):\n    return 1\n")
    (tmp_path / "colorama_or_so.py").write_text("raise RuntimeError('ran')\n")
    only_known(tmp_path / "r.py", {str(tmp_path / "r.py"): "0" * 64})
    try:
        with pytest.raises(UserError, match=r"r\.py is new or has changed"):
            load_reward_function(f"{tmp_path}/r.py:reward")
    finally:
        only_known(tmp_path / "r.py", None)


def test_a_path_is_absolute_from_the_given_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert absolute_source("r.py:f", tmp_path) == f"{tmp_path}/r.py:f"
    assert absolute_source("../x/r.py:f", tmp_path / "a") == f"{tmp_path}/x/r.py:f"
    assert absolute_source("~/r.py:f", tmp_path) == f"{tmp_path}/home/r.py:f"
    assert absolute_source("/r.py:f", tmp_path) == "/r.py:f"
    assert absolute_source("upright", tmp_path) == "upright"
