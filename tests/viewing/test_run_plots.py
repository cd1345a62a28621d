"""What the curves of a run show."""

import json

import matplotlib.figure
import numpy as np
import pytest

from mjx_walk.settings.config import load_config
from mjx_walk.settings.saved_config import save_config
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.viewing.run_plots import evaluations, plot_run


@pytest.fixture
def drawn(monkeypatch):
    """Every figure that is saved, in order."""
    figures = []

    def save(figure, path, **_):
        figures.append(figure)
        path.write_bytes(b"drawn")

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", save)
    return figures


def run_folder(path, rows):
    save_config(load_config(["env=half_cheetah", "algo=sac", "seed=3"]), path / "config.yaml")
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return RunFolder(path)


def test_evaluations_stand_where_their_policy_was_trained():
    rows = [{"env_steps": 100 * i, "wall_seconds": 10.0 * i} for i in range(1, 6)]
    rows[4] |= {"eval/env_steps": 250, "eval/return": 7.0}
    assert evaluations(rows, "env_steps", "return").tolist() == [[250.0], [7.0]]
    assert evaluations(rows, "wall_seconds", "return").tolist() == [[25.0], [7.0]]


def test_figures_name_the_run_and_leave_constants_out(tmp_path, drawn):
    rows = [{"env_steps": i, "wall_seconds": i, "train/loss": i, "train/constant": 2.0} for i in (1, 2, 3)]
    plot_run(run_folder(tmp_path, rows))
    assert all(figure.get_suptitle().startswith("HalfCheetah-v5, sac, seed 3") for figure in drawn)
    titles = [axes.get_title() for figure in drawn for axes in figure.axes]
    assert "loss" in titles and "constant" not in titles


def test_a_single_row_is_visible(tmp_path, drawn):
    plot_run(run_folder(tmp_path, [{"env_steps": 5, "wall_seconds": 5, "episode/return": 1.0, "train/loss": 2.0}]))
    lines = [line for figure in drawn for axes in figure.axes for line in axes.lines]
    assert len(lines) == 3 and all(line.get_marker() not in ("", "None") for line in lines)
    assert np.all([len(line.get_xdata()) == 1 for line in lines])
