"""A run's log, as it is read back."""

import json
import os

import matplotlib
import pytest

from mjx_walk.logs import metrics
from mjx_walk.logs.loggers import MetricsWriter
from mjx_walk.logs.metrics import read_rows
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.run_plots import plot_run


def line(step):
    return f'{{"env_steps": {step}, "wall_seconds": {step}.5}}\n'


def test_a_last_line_that_was_cut_off_is_left_out(tmp_path, recwarn):
    path = tmp_path / "metrics.jsonl"
    path.write_text(line(1) + line(2))
    with path.open("ab") as file:
        file.write(b'\xff\xfe{"env')
    assert [row["env_steps"] for row in read_rows(path)] == [1, 2] and not recwarn
    assert read_rows(tmp_path / "nowhere") == []


DAMAGE = [
    *("garbage", "7", "{}", "[]", "[" * 100_000, '{"env_steps": 2}', '{"wall_seconds": 2}'),
    *(f'{{"env_steps": {value}, "wall_seconds": 1}}' for value in ('"2"', "true", "null", "-1", "NaN", "Infinity")),
    f'{{"env_steps": 2, "wall_seconds": {"1" * 5000}}}',
    *(f'{{"env_steps": 2, "wall_seconds": 1, "episode/return": {value}}}' for value in ('"x"', "[1]", "{}", "1e999")),
    *(f'{{"env_steps": 2, "wall_seconds": 1, "{name}": 1}}' for name in ("=HYPERLINK(1)", "+1", "a\\u001b[2J", "")),
]


@pytest.mark.parametrize("damage", DAMAGE, ids=range(len(DAMAGE)))
def test_a_damaged_line_costs_no_other_line_and_is_told(tmp_path, damage):
    path = tmp_path / "metrics.jsonl"
    path.write_text(line(1) + damage + "\n" + line(3) + line(4))
    with pytest.warns(UserWarning, match=r"line 2 of .*metrics\.jsonl cannot be read"):
        MetricsWriter(tmp_path, resume_steps=3).close()
    assert path.read_text() == line(1) + line(3)


def test_many_damaged_lines_cost_one_warning(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text("x\n" * 1000 + line(3))
    with pytest.warns(UserWarning, match="line 1 and 999 more of") as warned:
        assert len(read_rows(path)) == 1
    assert len(warned) == 1


@pytest.fixture
def logged(tmp_path):
    """A log of four rows, and the position that a checkpoint stores with it."""
    writer = MetricsWriter(tmp_path)
    for step in (1, 2, 3, 4):
        writer.write({"env_steps": step, "wall_seconds": 0.1 + step, "train/loss": float("nan")})
    writer.close()
    return tmp_path / "metrics.jsonl", writer.position


def test_an_intact_log_resumes_in_silence(logged, recwarn):
    path, position = logged
    before = path.read_bytes()
    with path.open("a") as file:
        file.write(line(5) + '{"env')  # after the checkpoint
    writer = MetricsWriter(path.parent, 4, position)
    assert writer.position == position and path.read_bytes() == before and not recwarn
    writer.close()


@pytest.mark.parametrize("kept", [[0, 1, 2], [0, 2, 3], [1, 2], []])
def test_lost_rows_are_noticed(logged, kept):
    path, position = logged
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[i] for i in kept))
    with pytest.warns(UserWarning, match=rf"metrics\.jsonl has lost {4 - len(kept)} of 4 rows up to step 4"):
        MetricsWriter(path.parent, 4, position).close()


def test_a_changed_row_is_noticed(logged):
    path, position = logged
    path.write_text(path.read_text().replace("2.1", "2.2"))
    with pytest.warns(UserWarning, match=r"metrics\.jsonl was changed after the run wrote it, up to step 4"):
        MetricsWriter(path.parent, 4, position).close()


@pytest.mark.parametrize("is_replaced", [False, True])
def test_a_log_that_is_removed_during_training_is_begun_again(tmp_path, is_replaced):
    writer, path = MetricsWriter(tmp_path), tmp_path / "metrics.jsonl"
    writer.write({"env_steps": 1, "wall_seconds": 1.0})
    path.unlink()
    if is_replaced:
        path.write_text(line(1))
    with pytest.warns(UserWarning, match="was removed or replaced; its rows before step 2 are gone"):
        writer.write({"env_steps": 2, "wall_seconds": 2.0})
    writer.close()
    assert [row["env_steps"] for row in read_rows(path)] == ([1, 2] if is_replaced else [2])


def test_no_row_is_written_into_another_folder(tmp_path):
    (tmp_path / "run").mkdir()
    writer = MetricsWriter(tmp_path / "run")
    (tmp_path / "run").rename(tmp_path / "moved")
    (tmp_path / "run").mkdir()
    with pytest.raises(FileNotFoundError, match="run"):
        writer.write({"env_steps": 2, "wall_seconds": 2.0})
    writer.close()
    assert list((tmp_path / "run").iterdir()) == []


def test_a_log_is_never_written_through_a_link(tmp_path):
    """Neither one that was there, nor one that is put in place between the check and the first row."""
    (tmp_path / "precious").write_text("mine")
    path = tmp_path / "metrics.jsonl"
    os.link(tmp_path / "precious", path)
    MetricsWriter(tmp_path, resume_steps=3).close()
    path.unlink()
    path.symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic links"):
        MetricsWriter(tmp_path)
    assert (tmp_path / "precious").read_text() == "mine"


@pytest.mark.parametrize("name", [r"episode/reward_$\frac$", "episode/reward_" + "x" * 5000, "train/$$"], ids=range(3))
def test_names_in_a_log_cannot_stop_the_plots(tmp_path, name):
    rows = [{"env_steps": step, "wall_seconds": step, name: 1.0, "train/loss": 1e299} for step in (1, 2**63)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert [path.stat().st_size > 100 for path in plot_run(RunFolder(tmp_path))] == [True] * 4


@pytest.mark.parametrize("limit", ["_MAX_VALUES", "_MAX_LINES", "_MAX_LINE"])
def test_a_log_of_any_size_takes_little_memory(tmp_path, monkeypatch, limit):
    path = tmp_path / "metrics.jsonl"
    monkeypatch.setattr(metrics, limit, 100)
    if limit == "_MAX_LINE":
        path.write_text(line(1) + "x" * 1000 + "\n" + line(2))
        with pytest.warns(UserWarning, match="line 2 and 10 more of"):
            assert [row["env_steps"] for row in read_rows(path)] == [1, 2]
    else:
        path.write_text(line(1) * 101)
        with pytest.raises(UserError, match=r"metrics\.jsonl has too many rows for the log of a run; remove it"):
            read_rows(path)


def test_a_csv_file_has_a_limited_number_of_cells_and_no_formulas(tmp_path, monkeypatch):
    monkeypatch.setattr(metrics, "_MAX_CELLS", 6)
    rows = [{"run_dir": "=HYPERLINK(1)", f"train/{i}": -1.0} for i in range(3)]
    text = metrics.write_csv(rows, tmp_path / "metrics.csv").read_text()
    assert text.splitlines() == ["run_dir,train/0", "'=HYPERLINK(1),-1.0", "'=HYPERLINK(1),", "'=HYPERLINK(1),"]


def test_a_matplotlibrc_of_the_working_directory_has_no_effect(tmp_path):
    (tmp_path / "metrics.jsonl").write_text(line(1))
    with matplotlib.rc_context({"text.usetex": True, "font.size": 1e9, "figure.dpi": 1e9}):  # as it was read
        assert len(plot_run(RunFolder(tmp_path))) == 4


def test_a_log_of_many_names_draws_only_some(tmp_path):
    row = {"env_steps": 1, "wall_seconds": 1} | {f"train/{i}": 1.0 for i in range(100_000)}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    assert len(plot_run(RunFolder(tmp_path))) == 4
