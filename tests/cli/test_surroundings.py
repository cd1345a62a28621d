"""Unusual surroundings of a command: it works in them, or says in one line what to change."""

import ast
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest import mock

import jax
import pytest
import warp as wp
from helpers import CLONE, ENVIRONMENT

from mjx_walk import eval as eval_command
from mjx_walk import train as train_command
from mjx_walk.cli import parsing
from mjx_walk.envs.physics import warp_kernels
from mjx_walk.machine import compat
from mjx_walk.settings import trust
from mjx_walk.settings.config import load_config
from mjx_walk.storage import files, run_folder
from mjx_walk.training.checks import prepared
from mjx_walk.utils.errors import UserError


def in_shell(script, **kwargs):
    """A shell script in which `python` is this interpreter."""
    env = ENVIRONMENT | {"python": sys.executable}
    return subprocess.run(["bash", "-c", script], env=env, capture_output=True, check=False, **kwargs)


def test_with_a_closed_stream_everything_is_imported_and_it_stays_closed(tmp_path):
    code = "import mjx_walk, gymnasium.envs.mujoco, os; os.fstat(2)"
    done = in_shell(f'"$python" -c "{code}" 2>&-; echo $?', cwd=tmp_path)
    assert done.stdout == b"1\n"  # of fstat: no import fails
    assert in_shell('"$python" -m mjx_walk <&- >&- 2>&-', cwd=tmp_path).returncode == 0


def test_episodes_are_played_with_closed_streams():
    request = pickle.dumps(("InvertedPendulum-v5", {}, [(0, ())], False))
    script = '"$python" -m mjx_walk.evaluation.gymnasium_worker 2>&-'
    done = in_shell(script, input=request)
    assert pickle.loads(done.stdout)[0].shape == (1, 4)


@pytest.mark.slow
def test_a_command_with_all_streams_closed(tmp_path):
    command = '"$python" -m mjx_walk.eval run=zoo:inverted_pendulum-csac episodes=1'
    assert in_shell(f"{command} <&- >&- 2>&-", cwd=tmp_path).returncode == 0


def test_text_is_utf_8_in_every_locale():
    """The package names the encoding wherever it opens a file, or reads the output of a child process, as text."""
    for path in (*CLONE.glob("mjx_walk/**/*.py"), *CLONE.glob("envs/**/*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and _is_text(call):
                assert any(word.arg == "encoding" for word in call.keywords), f"{path}:{call.lineno}"


def _is_text(call):
    """Whether a call handles text in the locale's encoding unless it names another."""
    name = ast.unparse(call.func)
    words = {word.arg: ast.unparse(word.value) for word in call.keywords}
    if name.endswith((".read_text", ".write_text")):
        return True
    if name == "open" or name.endswith((".open", "fdopen")):
        given = [ast.unparse(argument) for argument in call.args]
        modes = [text for text in (*given, words.get("mode", "")) if text.strip("'") in ("r", "w", "a", "x")]
        return bool(modes) or (name == "open" and len(given) == 1 and "opener" not in words)
    return words.get("text") == "True" or "universal_newlines" in words


@pytest.fixture
def homeless(monkeypatch):
    """A user without a home folder, as an arbitrary one of a container."""
    for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "WARP_CACHE_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 5)


def test_without_a_home_compiled_programs_are_not_kept(homeless, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    former = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        warns = pytest.warns(UserWarning, match="not kept: there is no home folder; set JAX_COMPILATION_CACHE_DIR")
        with warns, compat.temporary_jax_settings("float32"):
            assert jax.config.jax_compilation_cache_dir is None
    finally:
        jax.config.update("jax_compilation_cache_dir", former)
    assert list(tmp_path.iterdir()) == []


def test_without_a_home_a_reward_function_is_named_each_time(homeless, caplog):
    trust.remember("/r.py:f", {"/r.py": "0"})
    assert "no home folder: set HOME or XDG_CONFIG_HOME, or a resume needs env.reward_function=/r.py:f" in caplog.text
    with pytest.raises(UserError, match=r"to run it, add env.reward_function=/r\.py:f"):
        trust.require_trusted("/r.py:f")


def test_without_a_home_warp_has_a_cache_of_its_own(homeless, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", None)
    with pytest.warns(UserWarning, match="set WARP_CACHE_PATH"):
        warp_kernels.choose_cache()
    assert Path(wp.config.kernel_cache_dir).is_dir()


@pytest.mark.parametrize(("value", "folder"), [("/x", "/x"), ("", "/h/.cache"), ("relative", "/h/.cache")])
def test_a_relative_cache_folder_is_ignored(monkeypatch, value, folder):
    monkeypatch.setenv("HOME", "/h")
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    assert files.user_folder("XDG_CACHE_HOME", ".cache") == Path(folder)


def line_of(command, arguments, monkeypatch, capsys):
    """The one line with which a command ends."""
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with pytest.raises(SystemExit) as ended:
        parsing.main(command)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("main", [train_command.main, eval_command.main])
def test_a_deleted_working_folder(tmp_path, monkeypatch, capsys, main):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    (tmp_path / "gone").mkdir()
    os.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert line_of(main, ["run=x"], monkeypatch, capsys).startswith("error: the working folder was deleted; change to")


def test_a_working_folder_that_is_deleted_during_a_command(tmp_path, monkeypatch, capsys):
    def command(_):
        (tmp_path / "gone").mkdir()
        os.chdir(tmp_path / "gone")
        (tmp_path / "gone").rmdir()
        os.path.abspath("x")

    monkeypatch.chdir(tmp_path)
    assert line_of(command, [], monkeypatch, capsys).startswith("error: the working folder was deleted; change to")


def test_an_argument_that_the_locale_cannot_read(monkeypatch, capsys):
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "ascii")
    line = line_of(train_command.main, [os.fsdecode(b"run_dir=gr\xc3\xb6\xff")], monkeypatch, capsys)
    expected = r"the argument 'run_dir=grö\xff' is no text in the encoding of this locale, ascii; set PYTHONUTF8=1"
    assert line == f"error: {expected}"


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (
            RuntimeError("Unable to initialize backend 'cuda':\nno plugin"),
            "Unable to initialize backend 'cuda': no plugin",
        ),
        (AssertionError(), "there is no such device; unset it, or set JAX_PLATFORMS=cpu"),
    ],
)
def test_jax_does_not_start(monkeypatch, capsys, error, says):
    monkeypatch.setattr(jax, "default_backend", mock.Mock(side_effect=error))
    line = line_of(train_command.main, ["env=walker2d"], monkeypatch, capsys)
    assert line == f"error: JAX does not start with JAX_PLATFORMS=cpu: {says}"


def test_no_folder_for_temporary_files(monkeypatch, capsys):
    def command(_):
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    assert "set TMPDIR to one that can be written" in line_of(command, [], monkeypatch, capsys)


def test_runs_that_start_in_the_same_second_get_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as threads:
        folders = list(threads.map(lambda _: run_folder.new_folder(Path("runs/x")), range(40)))
    assert len({*folders}) == 40 == len([*Path("runs/x").iterdir()])
    config = load_config(["env=walker2d", "physics=c"])
    with prepared([config]) as ((one,), _), prepared([config]) as ((other,), _):
        assert one.path != other.path and one.path.parent == other.path.parent == Path("runs/walker2d_ppo")
    with prepared([config, load_config(["env=walker2d", "physics=c", "seed=3"])]) as (several, configs):
        assert [folder.path.name for folder in several] == ["seed_0", "seed_3"]
        assert len({folder.path.parent for folder in several}) == 1
        assert [config.run_dir for config in configs] == [str(folder.path) for folder in several]


def test_sweeps_that_start_in_the_same_second_get_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with train_command._sweep_folder(True, []) as one, train_command._sweep_folder(True, []) as other:
        assert one != other and len([*Path("runs/sweeps").iterdir()]) == 2
    assert list(tmp_path.iterdir()) == []
    with train_command._sweep_folder(False, []) as none, train_command._sweep_folder(True, ["hydra.sweep.dir"]) as own:
        assert none == own == [] == list(tmp_path.iterdir())


def test_a_read_only_working_folder(tmp_path, monkeypatch):
    (tmp_path / "runs").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"cannot write to runs/walker2d_ppo: .*; give run_dir=PATH of another folder"):
        run_folder.new_folder(Path("runs/walker2d_ppo"))
