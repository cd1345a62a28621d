"""What signals do: the first asks, the second Ctrl-C insists, and neither interrupts what must be finished."""

import signal
import subprocess
import sys

import pytest
from helpers import CLONE

from mjx_walk.cli.console import console
from mjx_walk.machine.signals import Interrupt, Stopped, as_by_ctrl_c, exit_code, postponed, undisturbed


@pytest.fixture(autouse=True)
def usual_handlers():
    """Where tests run in the background, SIGINT is ignored."""
    numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
    former = [signal.signal(number, signal.SIG_DFL) for number in numbers]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in zip(numbers, former, strict=True):
        signal.signal(number, handler)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGUSR1", "SIGHUP"])
def test_a_signal_asks_to_stop(name):
    with Interrupt() as interrupt:
        signal.raise_signal(getattr(signal, name))
    assert interrupt.signal_name == name


@pytest.mark.parametrize("name", ["SIGTERM", "SIGUSR1", "SIGHUP"])
def test_later_stages_end_as_by_ctrl_c(name):
    with pytest.raises(Stopped) as stopped, as_by_ctrl_c():
        signal.raise_signal(getattr(signal, name))
    assert exit_code(stopped.value.signal_name) == 128 + getattr(signal, name)


def test_a_run_under_nohup_outlives_its_terminal():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with as_by_ctrl_c(), Interrupt() as interrupt:
        signal.raise_signal(signal.SIGHUP)
    assert interrupt.signal_name is None


def test_only_the_second_ctrl_c_interrupts_the_call():
    with Interrupt() as interrupt:
        signal.raise_signal(signal.SIGINT)
        assert interrupt.signal_name == "SIGINT"
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_signals_wait_for_what_must_be_finished():
    finished = []

    def finish():
        with as_by_ctrl_c(), postponed("finishing"):
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
            finished.append(True)

    with pytest.raises(Stopped, match="SIGTERM"):
        finish()
    assert finished


@pytest.mark.parametrize(("name", "raised"), [("SIGINT", KeyboardInterrupt), ("SIGTERM", Stopped)])
def test_a_device_program_ends_before_a_signal_takes_effect(name, raised):
    ended = []

    def run():
        with as_by_ctrl_c(), undisturbed("finishing"):
            signal.raise_signal(getattr(signal, name))
            ended.append(True)

    with pytest.raises(raised):
        run()
    assert ended


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_process_that_exits_ends_in_peace(name):
    """Others clean up at exit, which may take seconds."""
    program = (
        "import atexit, time; from mjx_walk.machine.signals import ignore_at_exit; "
        "atexit.register(lambda: (print('exiting', flush=True), time.sleep(0.5))); ignore_at_exit()"
    )
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", program], cwd=CLONE, text=True, **pipes) as process:
        assert process.stdout.readline() == "exiting\n"
        process.send_signal(getattr(signal, name))
        assert (process.wait(), process.stderr.read()) == (0, "")


@pytest.mark.parametrize(("error", "is_shown"), [(KeyboardInterrupt("three"), False), (ValueError("three"), True)])
def test_only_ctrl_c_is_hidden_where_code_cannot_raise(capsys, error, is_shown):
    class Raises:
        def __del__(self):
            raise error

    with console():
        Raises()
    assert ("three" in capsys.readouterr().err) == is_shown
