"""The first lines of a training say what may surprise."""

import logging

import pytest

from mjx_walk.settings.config import load_config
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.messages import announce


@pytest.mark.parametrize(("calls", "devices", "warns"), [(1, 1, False), (2, 1, True), (2, 2, False)])
def test_a_recording_that_may_hang_is_warned_of(calls, devices, warns, tmp_path, caplog):
    config = load_config(["physics=warp", f"profile_calls={calls}"])
    with caplog.at_level(logging.WARNING, "mjx_walk"):
        announce(config, [RunFolder(tmp_path)], devices)
    assert any("use profile_calls=1" in message for message in caplog.messages) is warns
