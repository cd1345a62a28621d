"""Programs wait for what an engine prepares in the background, unless nothing runs."""

import threading
from concurrent.futures import CancelledError, Future

import pytest

from mjx_walk.envs.physics import nothing_runs
from mjx_walk.envs.physics.preparation import Preparation


def test_a_trace_begins_the_work_once_and_waits_for_it():
    begun = []

    def begin():
        begun.append(Future())
        threading.Timer(0.05, begun[-1].set_result, [None]).start()
        return begun

    preparation = Preparation(begin)
    preparation.before_trace()
    assert begun[0].done()
    preparation.before_trace()
    assert len(begun) == 1


def test_it_does_not_begin_where_nothing_runs_and_reports_what_failed():
    future = Future()
    begun = []
    preparation = Preparation(lambda: begun.append(future) or [future])
    with nothing_runs():
        preparation.before_trace()
    assert not begun
    preparation.begin()
    assert begun == [future]
    future.set_exception(RuntimeError("no compiler"))
    for wait in (preparation.wait, preparation.before_trace):
        with pytest.raises(RuntimeError, match="no compiler"):
            wait()


def test_what_was_given_up_begins_again():
    futures = [Future(), Future()]
    preparation = Preparation(lambda: [futures.pop()])
    preparation.begin()
    preparation.cancel()
    with pytest.raises(CancelledError):
        preparation.wait()
    preparation.begin()
    assert not futures
