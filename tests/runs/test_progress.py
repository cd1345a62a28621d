"""What a training shows of its progress, in a terminal and outside one."""

import io
import logging
import sys

import pytest

from mjx_walk.runs.progress import Progress


def row(steps, rate, **others):
    return {"env_steps": steps, "speed/steps_per_second": rate, **others}


@pytest.fixture
def lines(caplog):
    caplog.set_level(logging.INFO, "mjx_walk.progress")
    return lambda: [record.getMessage().strip() for record in caplog.records]


def test_the_time_left_begins_after_compiling_and_the_last_row_is_shown(lines):
    shown = Progress(10_000, 0)
    assert lines() == ["Compiling the training, which takes from seconds to minutes"]
    shown.update(row(1_000, 10.0))
    shown.update(row(2_000, 50.0, **{"episode/return": 7.5, "episode/length": 20.0, "eval/return": 12.5}))
    shown.update(row(3_000, 50.0))  # soon after the one before
    shown.update(row(10_000, 50.0))
    shown.close()
    assert lines()[1:] == [
        "1,000 steps",
        "2,000 steps         50/s  return 7.50  length 20  eval 12.5  2 min 40 s left",
        "10,000 steps         50/s  eval 12.5",
    ]


def test_only_one_of_several_processes_shows_it(lines):
    shown = Progress(10_000, 0, is_shown=False)
    shown.update(row(10_000, 10.0))
    shown.close()
    assert lines() == []


def test_a_finished_run_compiles_nothing(lines):
    Progress(10_000, 10_000).close()
    assert lines() == []


def test_a_bar_in_a_terminal_says_what_is_done_and_leaves_compiling_out(lines, monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    shown = Progress(10_000, 0)
    assert "compiling:   0%" in terminal.getvalue()
    shown.update(row(1_000, 10.0))
    shown.update(row(2_000, 50.0, **{"episode/return": 7.5, "episode/length": 20.0}))
    shown.close()
    last = terminal.getvalue().split("\r")[-1]
    assert "training:  20%" in last and "return=7.50" in last and "2.00k/10.0k" in last
    assert lines() == []
