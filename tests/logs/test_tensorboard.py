"""TensorBoard's file never stops a training."""

import errno
import os

import pytest

from mjx_walk.logs.loggers import MetricsWriter
from mjx_walk.logs.metrics import read_rows

ROW = {"env_steps": 1, "wall_seconds": 1.0, "train/loss": 1.0}


def test_a_write_that_fails_warns_once_and_the_rows_go_on(tmp_path, monkeypatch, recwarn):
    writer = MetricsWriter(tmp_path)
    (events,) = tmp_path.glob("events.*")
    write = os.write

    def full(descriptor, data):
        if os.readlink(f"/proc/self/fd/{descriptor}") == str(events):
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", full)
    for step in range(1, 100):
        writer.write(ROW | {"env_steps": step})
    writer.close()
    assert [row["env_steps"] for row in read_rows(tmp_path / "metrics.jsonl")] == [*range(1, 100)]
    (warning,) = recwarn
    assert f"{events} cannot be written (No space left on device)" in str(warning.message)


def test_a_file_that_cannot_be_opened_warns_too(tmp_path, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "no/such/folder")
    with pytest.warns(UserWarning, match="TensorBoard gets no more rows"):
        writer = MetricsWriter(tmp_path)
    writer.write(ROW)
    writer.close()
    assert len(read_rows(tmp_path / "metrics.jsonl")) == 1
