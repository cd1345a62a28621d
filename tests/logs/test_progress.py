"""What a training shows of its progress, in a terminal and outside one."""

import io
import logging
import sys

import pytest

from mjx_walk.logs import progress
from mjx_walk.logs.progress import Progress, ScoringProgress


def row(steps, rate, **others):
    return {"env_steps": steps, "speed/steps_per_second": rate, **others}


@pytest.fixture
def lines(caplog):
    caplog.set_level(logging.INFO, "mjx_walk.progress")
    return lambda: [record.getMessage().strip() for record in caplog.records]


def test_the_time_left_begins_after_compiling_and_the_last_row_is_shown(lines):
    shown = Progress(10_000, 0)
    assert lines() == ["Compiling the training program, which takes seconds to minutes"]
    shown.update(row(1_000, 10.0))
    shown.update(row(2_000, 50.0, **{"episode/return": 7.5, "episode/length": 20.0, "eval/return": 12.5}))
    shown.update(row(3_000, 50.0))  # soon after the one before
    shown.update(row(10_000, 50.0))
    shown.close()
    assert lines()[1:] == [
        "1,000 steps",
        "2,000 steps         50/s  return 7.50  length 20  eval 12.5  2 min 40 s left",
        "10,000 steps         50/s  eval 12.5",
        "Evaluating the final policy and drawing the curves",
    ]


def test_filling_the_replay_is_said_and_has_no_time_left(lines):
    shown = Progress(10_000, 0)
    for steps, updates in ((1_000, 0.0), (2_000, 0.0), (3_000, 8.0)):
        shown.update(row(steps, 50.0, **{"train/critic_updates": updates, "eval/return": 1.0}))
    shown.close()
    assert lines()[1:] == [
        "Filling the replay, before learning starts",
        "1,000 steps  eval 1.00",
        "2,000 steps         50/s  eval 1.00",
        "3,000 steps         50/s  eval 1.00  2 min 20 s left",
    ]


def test_only_one_of_several_processes_shows_it(lines):
    shown = Progress(10_000, 0, is_shown=False)
    shown.update(row(10_000, 10.0))
    shown.close()
    assert lines() == []


def test_a_finished_run_compiles_nothing(lines):
    Progress(10_000, 10_000).close()
    assert lines() == []


def open_terminal(monkeypatch):
    """Collects what is printed to a terminal of 80 columns."""
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("COLUMNS", "80")
    return stream


def last_bar(terminal):
    return [text for text in terminal.getvalue().split("\r") if text.strip()][-1]


def test_a_bar_in_a_terminal_says_what_is_done_and_leaves_compiling_out(lines, monkeypatch):
    terminal = open_terminal(monkeypatch)
    shown = Progress(10_000, 0)
    assert "compiling:   0%" in terminal.getvalue()
    shown.update(row(1_000, 10.0))
    shown.update(row(2_000, 50.0, **{"episode/return": 7.5, "episode/length": 20.0}))
    shown.show_stage("saving")
    assert "saving:  20%" in last_bar(terminal)
    shown.close()
    last = last_bar(terminal)
    assert "training:  20%" in last and "return=7.50" in last and "2.00k/10.0k" in last
    assert "left" in last and "length" not in last
    assert lines() == []


def test_a_bar_says_that_the_replay_is_filled(lines, monkeypatch):
    terminal = open_terminal(monkeypatch)
    shown = Progress(10_000, 0)
    shown.update(row(1_000, 50.0, **{"train/critic_updates": 0.0}))
    shown.update(row(2_000, 50.0, **{"train/critic_updates": 0.0}))
    shown.show_stage("saving")
    assert "left" not in last_bar(terminal)
    shown.update(row(3_000, 50.0, **{"train/critic_updates": 8.0}))
    shown.close()
    assert "filling the replay:  10%" in terminal.getvalue() and "training:  30%" in last_bar(terminal)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(48, "48 s"), (281, "4 min 41 s"), (2_461, "41 min"), (3_569, "59 min"), (3_720, "1 h 2 min")],
)
def test_long_times_are_in_minutes(seconds, text):
    assert progress._in_minutes(seconds) == text


def test_scoring_has_a_bar_in_a_terminal(lines, monkeypatch):
    terminal = open_terminal(monkeypatch)
    shown = ScoringProgress(20, 200)
    assert "scoring:   0%" in terminal.getvalue()
    shown.update(1, 0)
    shown.update(150, 5)
    shown._bar.refresh()
    assert "scoring:  75%" in last_bar(terminal) and "150/200" in last_bar(terminal)
    assert last_bar(terminal).endswith("5 of 20 episodes over")
    shown.close()
    assert lines() == []


def test_scoring_says_how_far_it_is_elsewhere(lines, monkeypatch):
    seconds = iter([0.0, 5.0, 10.0, 16.0, 20.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(seconds))
    shown = ScoringProgress(20, 2_000)
    for steps, num_over in ((1, 0), (501, 2), (1_101, 5), (1_500, 9)):
        shown.update(steps, num_over)
    shown.close()
    assert lines() == ["step 1,101 of 2,000, 5 of 20 episodes over, at most 9 s left"]
