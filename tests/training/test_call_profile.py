"""Recording calls of a training with JAX's profiler; test_bench.py reads recordings."""

import jax
import pytest
from jax._src import profiler

from mjx_walk.training.call_profile import CALLS_BEFORE, CallProfile


@pytest.fixture(autouse=True)
def no_recording_stays_open():
    yield
    profiler._profile_state.reset()


def record(folder):
    with CallProfile(folder, num_calls=1) as profile:
        for _ in range(CALLS_BEFORE + 1):
            profile.next_call()


def test_a_recording_that_cannot_be_written_costs_a_warning(tmp_path, caplog):
    folder = tmp_path / "profile"
    folder.write_text("no folder")
    record(folder)
    (line,) = caplog.messages
    assert line.startswith(f"cannot write the recording of calls to {folder}: ") and "not a directory" in line


def test_a_removed_run_folder_is_not_made_anew(tmp_path, caplog):
    record(tmp_path / "run" / "profile")
    assert caplog.messages[0].endswith("its run folder was removed") and list(tmp_path.iterdir()) == []


def test_the_users_own_recording_goes_on(tmp_path, caplog):
    jax.profiler.start_trace(tmp_path / "theirs")
    record(tmp_path / "profile")
    assert caplog.messages[0].startswith("cannot record calls: Profile has already been started.")
    jax.profiler.stop_trace()
    assert [path.name for path in tmp_path.iterdir()] == ["theirs"]
