"""`mjx-walk`: the list of commands, and each of them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import ENVIRONMENT

import mjx_walk
from mjx_walk import __main__ as commands

CLONE = Path(__file__).parent.parent


def call(monkeypatch, *arguments):
    """The exit code of `mjx-walk ARGUMENTS`, in this process."""
    monkeypatch.setattr(sys, "argv", ["mjx-walk", *arguments])
    try:
        return commands.main()
    except SystemExit as stop:
        return stop.code


def test_the_list_has_every_command_with_its_example_and_what_it_does(monkeypatch, capsys):
    paths = [path for path in (CLONE / "mjx_walk").rglob("*.py") if "parsing.main(main)" in path.read_text()]
    names = [path.parent.name if path.stem == "__main__" else path.stem for path in paths]
    assert sorted(names) == sorted(commands.COMMANDS)
    assert call(monkeypatch) == 0
    listed = capsys.readouterr().out
    assert "  mjx-walk train env=humanoid algo=ppo\n      train one run, or a sweep with -m.\n" in listed
    assert all(f"  mjx-walk {name}" in listed for name in names) and "`" not in listed
    assert [call(monkeypatch, flag) for flag in ("--help", "-h", "help")] == [0, 0, 0]
    assert capsys.readouterr().out == 3 * listed


def test_the_list_needs_no_jax():
    code = "import sys; from mjx_walk.__main__ import usage; usage(); sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=False).returncode == 0


@pytest.mark.parametrize("argument", ["--help", "--version", "trai"])
def test_a_reader_that_ends_early_gets_no_traceback(argument):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as output:
        line = [sys.executable, "-m", "mjx_walk", argument]
        done = subprocess.run(line, env=ENVIRONMENT, stdout=output, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == (2 if argument == "trai" else 0) and "Traceback" not in done.stderr


@pytest.mark.parametrize("arguments", [["--version"], ["train", "--version"], ["zoo", "--version"]])
def test_the_version_is_ours(monkeypatch, capsys, arguments):
    assert call(monkeypatch, *arguments) == 0
    assert capsys.readouterr().out == f"mjx_walk {mjx_walk.__version__}\n"


def test_a_command_gets_its_arguments(monkeypatch, capsys):
    assert call(monkeypatch, "zoo") == 0
    assert "`zoo:humanoid-csac`" in capsys.readouterr().out
    assert call(monkeypatch, "eval", "run=nowhere") == 2
    assert capsys.readouterr().err.startswith("error: no run at 'nowhere'")


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("trai", "did you mean: train?"),
        ("env=humanoid", "did you mean: train env=humanoid?"),
        ("evaluate", "did you mean: eval?"),
        ("watch", "did you mean: play?"),
        ("run=x", "did you mean: play run=x?"),
        ("zoo:humanoid-csac", "did you mean: play run=zoo:humanoid-csac?"),
        ("-v", "did you mean: --version?"),
        (
            "--env",
            "the command comes first; "
            "choose one of: train, eval, play, plots, export, zoo, compare, tune, bench, parity",
        ),
        ("fly", "choose one of: train, eval, play, plots, export, zoo, compare, tune, bench, parity"),
    ],
)
def test_an_unknown_command_is_named(monkeypatch, capsys, command, says):
    assert call(monkeypatch, command) == 2
    assert capsys.readouterr().err == f"error: unknown command '{command}'; {says}\n"


def test_the_package_shows_its_public_names():
    assert dir(mjx_walk) == sorted(mjx_walk.__all__)
    assert all(hasattr(mjx_walk, name) for name in dir(mjx_walk))
