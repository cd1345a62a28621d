"""The tables of scores in README.md and docs/results.md."""

import importlib
import re

import numpy as np
import pytest
import scipy.stats
from helpers import CLONE

from mjx_walk.experiments.suite import REFERENCES, normalize

DOCS = CLONE / "docs"


@pytest.fixture(autouse=True)
def _generator_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))


def read(name):
    return importlib.import_module("generator.score_tables").read(name)


def test_readme_shows_the_best_algorithm_of_each_task():
    rows = read("results.csv")
    shown = [row for row in rows if row["published_v5"]]
    assert len(shown) == 3
    for row in shown:
        assert float(row["score"]) == max(float(other["score"]) for other in rows if other["task"] == row["task"])


def test_normalized_scores_follow_from_the_table():
    text = (DOCS / "results.md").read_text()
    scores = {row["id"]: row for row in read("experiments.csv") if row["id"].startswith("MS")}
    found = []
    for suffix in ("", "@best"):
        rows = [scores[f"MS{number}{suffix}"] for number in range(1, 12)]
        assert [f"{row['task']}-{row['version']}" for row in rows] == list(REFERENCES)
        values = [normalize(f"{row['task']}-{row['version']}", float(row["final_mean"])) for row in rows]
        found += [f"{np.mean(values):.2f}", f"{scipy.stats.trim_mean(values, 0.25):.2f}"]
    sentence = r"mean of ([\d.]+) and an interquartile mean of ([\d.]+), the best\s+ones ([\d.]+) and ([\d.]+)\."
    assert list(re.search(sentence, text).groups()) == found


def test_the_scaling_figure_shows_the_factors_of_the_table():
    figure = importlib.import_module("scaling_figure")
    found = [f"{factor:.2f}" for values in figure.factors().values() for factor in values[1:]]
    text = (DOCS / "results.md").read_text()
    shown = re.findall(r"^\| (?:PPO|csac) \| [24] \| [\d,]+ \| [\d,]+ \| ([\d.]+) \| [24] \|", text, flags=re.MULTILINE)
    assert found == shown and len(shown) == 8
