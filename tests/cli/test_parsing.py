"""What commands print, and where."""

import dataclasses
import logging
import os
import subprocess
import sys
import warnings

import pytest
from helpers import ENVIRONMENT, TINY, TINY_CALL, command_here
from shared_programs import shared_programs

import mjx_walk
from mjx_walk.cli import parsing
from mjx_walk.cli.console import console


def test_commands_print_messages_without_prefix_and_warnings_in_one_line(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["command", "key=value"])

    def speak(arguments):
        logging.getLogger("mjx_walk.training").info("%s done", 50)
        logging.getLogger("mjx_walk.progress").info("5 steps")
        logging.getLogger("mjx_walk.api").warning("beware")
        warnings.warn("look out", stacklevel=1)
        return len(arguments)

    handlers = list(logging.getLogger("mjx_walk").handlers)
    with pytest.warns(UserWarning, match="look out"), pytest.raises(SystemExit) as ended:
        parsing.main(speak)
    assert ended.value.code == 1 and logging.getLogger("mjx_walk").handlers == handlers
    printed = capsys.readouterr()
    assert printed.out == "50 done\n" and printed.err == "5 steps\nwarning: beware\n"


def test_a_warning_from_two_places_is_shown_once():
    with console():
        shown = [warnings.formatwarning("look out", UserWarning, file, 1) for file in ("a.py", "b.py")]
    assert shown == ["warning: look out\n", ""]


def test_from_python_a_run_is_quiet_and_logs(tmp_path, capfd, caplog):
    with shared_programs():
        mjx_walk.run([*TINY, f"run_dir={tmp_path}/quiet", f"total_steps={TINY_CALL}"])
    printed = capfd.readouterr()
    assert "Training" not in printed.out and "steps" not in printed.err
    with caplog.at_level(logging.INFO, logger="mjx_walk"), shared_programs():
        mjx_walk.run([*TINY, f"run_dir={tmp_path}/logged", f"total_steps={TINY_CALL}"])
    assert "Training walker2d with ppo on the CPU, physics=c" in caplog.text and "64 steps" in caplog.text


def test_a_training_command_shows_messages_and_progress(tmp_path, capfd):
    assert command_here("train", *TINY, f"run_dir={tmp_path}/run", f"total_steps={TINY_CALL}") == 0
    printed = capfd.readouterr()
    assert "Training walker2d with ppo on the CPU" in printed.out and "64 steps" in printed.err


def test_text_is_taken_as_it_is():
    @dataclasses.dataclass
    class Arguments:
        run: str | None = None
        episodes: int = 1

    for text in ("007", "${x}", "jos\u00e9 (1)=2", "null", "[a]", "'q'"):
        assert parsing.parse(Arguments, [f"run={text}", "episodes=2"], "").run == text


@pytest.mark.parametrize("command", ["eval", "play", "plots", "export"])
def test_a_path_that_is_too_long_is_refused_in_one_line(command, capsys):
    assert command_here(command, f"run={'x' * 300}") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and "File name too long" in line


def test_a_command_finishes_its_work_when_the_reader_of_its_output_ends(monkeypatch, tmp_path):
    """`train … | head -1`: what it prints has no reader from then on."""
    reader, writer = os.pipe()
    monkeypatch.setattr(sys, "argv", ["command"])
    monkeypatch.setattr(sys, "stdout", os.fdopen(writer, "w"))

    def work(_):
        logging.getLogger("mjx_walk.training").info("first")
        os.close(reader)
        logging.getLogger("mjx_walk.training").info("second")
        print("third")
        (tmp_path / "result").touch()
        print("fourth", flush=True)

    with pytest.raises(SystemExit) as ended:
        parsing.main(work)
    assert ended.value.code == 0 and (tmp_path / "result").exists()
    sys.stdout.close()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux")
def test_output_on_a_full_disk_is_reported_in_one_line():
    code = (
        "import sys; from mjx_walk.cli import parsing; "
        "parsing.main(lambda _: print('text') or sys.exit(int(sys.argv[1])))"
    )
    for status in ("0", "1"):
        with open("/dev/full", "w") as full:
            process = [sys.executable, "-c", code, status]
            done = subprocess.run(process, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 2 and done.stderr == "error: [Errno 28] No space left on device\n"


def test_a_command_runs_without_output_and_in_any_encoding(monkeypatch, tmp_path):
    path = tmp_path / "output"
    for stdout in (None, path.open("w", encoding="ascii")):
        monkeypatch.setattr(sys, "argv", ["command"])
        monkeypatch.setattr(sys, "stdout", stdout)
        with pytest.raises(SystemExit) as ended:
            parsing.main(lambda _: print("2 × 3"))
        assert ended.value.code == 0
    assert path.read_text() == "2 \\xd7 3\n"
