"""The experiment log: docs/experiments.csv holds the figures, docs/experiments.md what follows from them."""

import csv
import re
from collections import Counter

import pytest
from helpers import CLONE

COLUMNS = [
    "id",
    "task",
    "version",
    "algorithm",
    "what_differs",
    "seeds",
    "steps",
    "measure",
    "final_mean",
    "std",
    "seconds",
    "machine",
    "versions",
    "verdict",
]
MEASURES = {
    "noisy_return",
    "inline_evaluation",
    "gymnasium",
    "target_mass",
    "speed",
    "critic_updates",
    "kl",
    "entropy",
    "noise_std",
}
VERDICTS = {"kept", "rejected", "cut_off", "measured"}
NOT_IDS = {"H100", "H200"}
"""GPUs, which look like ids."""

PAGE = (CLONE / "docs" / "experiments.md").read_text()
CITATION = re.compile(r" \(([A-Z]+\d*(?:, [A-Z]+\d*)*)\)\.$")

with (CLONE / "docs" / "experiments.csv").open(newline="") as _file:
    _READER = csv.DictReader(_file, strict=True)
    ROWS = list(_READER)
    HEADER = _READER.fieldnames
IDS = {row["id"] for row in ROWS}


def test_header_and_cells():
    assert HEADER == COLUMNS
    for row in ROWS:
        assert None not in row and None not in row.values(), row  # as many cells as columns
        assert row["id"] and row["task"] and row["what_differs"], row


def test_ids_and_measures_are_unique():
    counts = Counter((row["id"], row["measure"]) for row in ROWS)
    assert [key for key, count in counts.items() if count > 1] == []


def test_an_id_stands_for_one_task_and_algorithm():
    """Also where an arm's seeds and measures have rows of their own."""
    named = {}
    for row in ROWS:
        arm = re.split(r"[.@]", row["id"])[0]
        named.setdefault(arm, set()).add((row["task"], row["version"], row["algorithm"]))
    assert {arm: tasks for arm, tasks in named.items() if len(tasks) > 1} == {}


def test_measures_and_verdicts_are_listed_here_and_on_the_page():
    assert {row["measure"] for row in ROWS} == MEASURES
    assert {row["verdict"] for row in ROWS} == VERDICTS
    for word in (*COLUMNS, *MEASURES, *VERDICTS):
        assert f"`{word}`" in PAGE


@pytest.mark.parametrize("column", ["steps", "final_mean", "std", "seconds"])
def test_numbers_are_plain(column):
    for row in ROWS:
        assert re.fullmatch(r"-?\d+(\.\d+)?", row[column]) or (row[column] == "" and column != "final_mean"), row


def test_seeds_are_integers():
    for row in ROWS:
        assert re.fullmatch(r"(\d+( \d+)*)?", row["seeds"]), row


def test_means_are_those_of_the_seeds():
    """Where each seed has a row, to the last digit: a mean may have been taken before its seeds were rounded."""
    values = {(row["id"], row["measure"]): float(row["final_mean"]) for row in ROWS}
    compared = 0
    for row in ROWS:
        arm, _, point = row["id"].partition("@")
        ids = [f"{arm}.s{seed}" + (f"@{point}" if point else "") for seed in row["seeds"].split()]
        scores = [values[id_, row["measure"]] for id_ in ids if (id_, row["measure"]) in values]
        if len(scores) == len(ids) > 1:
            compared += 1
            assert sum(scores) / len(scores) == pytest.approx(
                float(row["final_mean"]), abs=1.0 if abs(float(row["final_mean"])) >= 100 else 0.01
            ), row
    assert compared >= 40


def test_conclusions_cite_arms_of_the_log():
    citations = {line: CITATION.search(line) for line in PAGE.splitlines() if line.startswith("- ")}
    assert citations
    assert [line for line, found in citations.items() if found is None] == []
    cited = {id_ for found in citations.values() if found for id_ in found[1].split(", ")}
    prefixes = "|".join({re.sub(r"[^A-Z].*", "", id_) for id_ in IDS})
    mentioned = set(re.findall(rf"\b(?:{prefixes})\d+\b", PAGE)) - NOT_IDS
    assert (cited | mentioned) - IDS == set()
