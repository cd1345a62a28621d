"""A run's log, as it is read back."""

import json

import pytest

from mjx_walk.runs.loggers import MetricsWriter
from mjx_walk.runs.metrics import read_rows


def test_a_last_line_that_was_cut_off_is_left_out(tmp_path, recwarn):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"env_steps": 1}\n{"env_steps": 2}\n\xff\xfe{"env')
    assert read_rows(path) == [{"env_steps": 1}, {"env_steps": 2}] and not recwarn
    assert read_rows(tmp_path / "nowhere") == []


@pytest.mark.parametrize("damage", ["garbage", "7", "{}"])
def test_a_damaged_line_costs_no_other_line_and_is_told(tmp_path, damage):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"env_steps": 1}\n' + damage + '\n{"env_steps": 3}\n{"env_steps": 4}\n')
    with pytest.warns(UserWarning, match=r"line 2 of .*metrics\.jsonl cannot be read"):
        MetricsWriter(tmp_path, resume_steps=3).close()
    assert [json.loads(line) for line in path.read_text().splitlines()] == [{"env_steps": 1}, {"env_steps": 3}]
