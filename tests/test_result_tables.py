"""The tables of figures in README.md, docs/results.md and docs/speed.md."""

import datetime
import importlib
import re

import numpy as np
import PIL.Image
import pytest
import scipy.stats
from helpers import CLONE, PAGES

from mjx_walk.experiments.suite import REFERENCES, normalize

DOCS = CLONE / "docs"


@pytest.fixture(autouse=True)
def _generator_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))


def read(name):
    return importlib.import_module("generator.score_tables").read(name)


def cells(page):
    """The rows of all tables of a page, as lists of cells."""
    lines = [line for line in (CLONE / page).read_text().splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_readme_shows_the_best_recipe_of_each_task():
    """The scores of several seeds, or else the highest one of a single seed, which the table says."""
    shown = [row for row in cells("README.md") if row[0] in REFERENCES]
    assert [row[0] for row in shown] == list(REFERENCES)
    arms = importlib.import_module("generator.best_recipes").ONE_SEED
    log = [row for row in read("experiments.csv") if row["id"] in arms]
    results = importlib.import_module("generator.score_tables").results()
    for task, algorithm, score, _, seeds, *_ in shown:
        of_task = [row for row in results if row["task"] == task]
        one_seed = [row for row in log if row["task"] == task.removesuffix("-v5")]
        scores = [float(row["score"]) for row in of_task] or [float(row["final_mean"]) for row in one_seed]
        assert float(score.replace(",", "")) == pytest.approx(max(scores), rel=2e-3)
        assert algorithm.lower() in {row["algorithm"].lower() for row in of_task or one_seed}
        assert (seeds == "1") == (not of_task)


def test_the_comparison_shows_the_highest_published_scores():
    highest = importlib.import_module("generator.score_tables").highest_published
    rows = [row for row in cells("docs/results.md") if len(row) == 10 and f"{row[0]}-v5" in REFERENCES]
    assert [f"{row[0]}-v5" for row in rows] == list(REFERENCES)
    for name, _, _, _, mean, _, single, _, old_mean, _ in rows:
        task = f"{name}-v5"
        expected = (highest(task), highest(task, several_seeds=False), highest(f"{name}-v4"))
        values = [None if shown == "–" else float(shown.replace(",", "")) for shown in (mean, single, old_mean)]
        assert values == [row and float(row["score"]) for row in expected], task


def test_final_scores_of_recipes_are_in_the_log():
    log = [row for row in read("experiments.csv") if row["measure"] == "gymnasium"]
    for row in read("results.csv"):
        if row["policy"] != "final":
            continue
        task = row["task"].removesuffix("-v5")
        arms = [arm for arm in log if arm["task"] == task and arm["final_mean"] == row["score"]]
        (arm,) = [arm for arm in arms if round(float(arm["std"])) == int(row["std"])]
        seeds = [
            float(one["final_mean"]) for one in log if one["id"].startswith(f"{arm['id']}.s") and "@" not in one["id"]
        ]
        assert len(seeds) == int(row["seeds"]) and min(seeds) == float(row["lowest_seed"])
        assert f"{int(arm['steps']) / 1e6:.1f}" == row["million_steps"]


def test_times_of_one_seed_alone_are_in_the_log():
    alone = [row for row in read("results.csv") if row["alone_seconds"]]
    log = {(row["task"], row["seconds"]) for row in read("experiments.csv") if re.fullmatch(r"\d+", row["seeds"])}
    assert alone and {(row["task"].removesuffix("-v5"), row["alone_seconds"]) for row in alone} <= log


def test_published_rows_have_link_date_and_budget():
    page = (DOCS / "results.md").read_text()
    for row in read("published.csv"):
        assert re.fullmatch(r"https://huggingface.co/\S+|https://github.com/\S+/blob/[0-9a-f]{40}/\S+", row["link"]), (
            row
        )
        assert datetime.date.fromisoformat(row["date"]) and row["source"] and row["policy"], row
        assert float(row["million_steps"]) > 0 and int(row["seeds"]) > 0, row
        assert f"({row['link']})" in page


def test_pages_compare_with_the_highest_that_was_found():
    """Never with "the record", which nobody can know."""
    tables = importlib.import_module("generator.score_tables")
    means = [tables.highest_published(row["task"]) for row in read("published.csv") if row["std"]]
    highest = {tables.number(row["score"]) for row in means if row}
    named = []
    for text in (" ".join(text.split()) for text in PAGES.values()):
        assert not re.search(r"\bthe (published |world )?record\b", text)
        named += re.findall(r"multi-seed mean that we found published is ([\d,]*\d)", text)
    assert named and {*named} <= highest


def test_references_are_the_highest_means_of_slm_lab():
    rows = [row for row in read("published.csv") if row["source"] == "SLM-Lab"]
    for task, (_, reference) in REFERENCES.items():
        assert reference == max(float(row["score"]) for row in rows if row["task"] == task)
        assert all(int(row["seeds"]) == 4 for row in rows)


def test_normalized_scores_follow_from_the_table():
    scores = {row["id"]: row for row in read("experiments.csv") if row["id"].startswith("MS")}
    found = []
    for suffix in ("", "@best"):
        rows = [scores[f"MS{number}{suffix}"] for number in range(1, 12)]
        assert [f"{row['task']}-{row['version']}" for row in rows] == list(REFERENCES)
        values = [normalize(f"{row['task']}-{row['version']}", float(row["final_mean"])) for row in rows]
        found.append([f"{np.mean(values):.2f}", f"{scipy.stats.trim_mean(values, 0.25):.2f}"])
    assert [row[1:] for row in cells("docs/results.md") if row[0] in ("final", "best")] == found


def test_no_factor_exceeds_the_number_of_gpus():
    scaling = importlib.import_module("generator.scaling")
    for algorithm in scaling.ON_ONE_GPU:
        for same_total in (False, True):
            factors = scaling.factors(algorithm, same_total)
            assert list(factors) == [2, 4] and all(1 < factor <= gpus for gpus, factor in factors.items())


def test_the_scaling_figure_shows_the_factors_of_the_table():
    """The figure notes what it draws."""
    with PIL.Image.open(DOCS / "scaling.png") as figure:
        assert figure.text["Description"] == importlib.import_module("generator.scaling").summary()


def test_pages_name_the_first_start_of_the_table():
    section = (DOCS / "speed.md").read_text().partition("## First start")[2]
    starts = {
        name: [int(x) for x in row] for name, *row in re.findall(r"\| (\w+) \| (\d+) \| (\d+) \| (\d+) \|", section)[:2]
    }
    assert starts.keys() == {"PPO", "csac"} and all(first - later == more for first, later, more in starts.values())


def test_the_error_that_pages_name_is_the_largest_of_the_table():
    errors = [float(row[6]) for row in cells("docs/exactness.md") if len(row) == 9 and row[1] in ("warp", "jax")]
    assert len(errors) == 42
    for page in ("README.md", "docs/fidelity.md"):
        text = " ".join((CLONE / page).read_text().split())
        (named,) = re.findall(r"error of the observation is at most ([^ ,]+)", text)
        assert float(named) == max(errors)


NUMBER = r"(?<![\w.,-])\d+(?:,\d{3})*(?:\.\d+)?(?:e-?\d+)?(?![\w]|\.\d|,\d)"
NO_FIGURES = {"5,000", "525", "580", "95"}
"""Not measured: 1,000 steps with a reward of 5, versions of NVIDIA's driver, and 95% intervals."""


@pytest.mark.parametrize(
    "page",
    [
        *("README", "docs/quick_start", "docs/concepts", "docs/training", "docs/troubleshooting"),
        *("docs/results", "docs/speed"),
    ],
)
def test_numbers_in_prose_are_in_a_table(page):
    """All numbers above ten and all with a fraction, without versions, which README's comparison is full of."""
    text = (CLONE / f"{page}.md").read_text().partition("## Comparison")[0]
    no_prose = r"```.*?```|`[^`]*`|\]\([^)]*\)|^\|.*?$|\b(?:Python|JAX|jax|Warp|Brax) [\d.]+"
    prose = re.sub(no_prose, "", text, flags=re.DOTALL | re.MULTILINE)
    shown = [cell for name in ("results", "speed", "exactness") for row in cells(f"docs/{name}.md") for cell in row]
    known = {float(number.replace(",", "")) for cell in shown for number in re.findall(NUMBER, cell)}
    known |= {float(row["final_mean"]) for row in read("experiments.csv") if row["measure"] == "gymnasium"}
    roughly = {float(f"{value:.1e}") for value in known}
    unknown = []
    for about, number in re.findall(rf"(about )?({NUMBER})", prose):
        value = float(number.replace(",", ""))
        is_a_figure = (value > 10 or not value.is_integer()) and number not in NO_FIGURES
        if is_a_figure and value not in (roughly if about else known):
            unknown.append(number)
    assert unknown == []


def test_every_number_of_readme_has_a_source():
    """Each claim stands in README, names arms of the log, and every sentence with a number has a claim."""
    text = (CLONE / "README.md").read_text()
    claims = read("claims.csv")
    assert [row["claim"] for row in claims if row["claim"] not in " ".join(text.split())] == []
    log = {row["id"] for row in read("experiments.csv")}
    assert {arm for row in claims for arm in re.findall(r"\b(?:[HS]\d+|[A-Z]{2}\d+)\b", row["source"])} <= log
    unsourced = [line for line in sentences_with_numbers(text) if not any(row["claim"] in line for row in claims)]
    assert unsourced == []
    rows = [line for line in text.splitlines() if re.match(r"\| \w+-v5 \|", line)]
    assert [line for line in rows if sum(line.startswith(row["claim"]) for row in claims) != 1] == []


def sentences_with_numbers(text):
    """Sentences of README before its comparison of projects, without tables, programs and targets of links."""
    prose = re.sub(r"```.*?```", "", text.partition("## Comparison")[0], flags=re.DOTALL)
    prose = re.sub(r"^\||^- ", "\n", re.sub(r"^\|.*\|$", "", prose, flags=re.MULTILINE), flags=re.MULTILINE)
    for paragraph in prose.split("\n\n"):
        for sentence in re.split(r"(?<=[.:!?])\s+(?=[A-Z`*\[])", " ".join(paragraph.split())):
            bare = re.sub(r"`[^`]*`|\]\([^)]*\)|\b[A-Za-z]\w*\d\w*|A2C", "", sentence)
            if re.search(r"\d", bare):
                yield sentence
