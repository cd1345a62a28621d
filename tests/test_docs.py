"""The generated parts of the documentation."""

import dataclasses
import importlib
import os
import re
from pathlib import Path

import pytest
from helpers import CLONE, PAGES

from mjx_walk.algos import ALGORITHMS, BUILT_IN_ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.settings.config import Config
from mjx_walk.utils import setting_fields

DOCS = CLONE / "docs"


@pytest.fixture(autouse=True)
def _generator_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))


def tasks_with_pages():
    return importlib.import_module("generator.task_pages").NAMES


def test_committed_pages_are_what_the_code_gives():
    pages = importlib.import_module("generate").pages()
    stale = [str(path.relative_to(CLONE)) for path, text in pages.items() if path.read_text() != text]
    assert not stale, "run python docs/generate.py, and commit its changes"
    names = {Path(os.path.relpath(path, DOCS)).as_posix() for path in pages}
    assert names == {
        *("../README.md", "results.md", "claims.md", "results_archive.md", "speed.md", "training.md", "tuning.md"),
        *(f"tasks/{name}.md" for name in ("index", *tasks_with_pages())),
        *(f"algorithms/{name}.md" for name in ("index", *BUILT_IN_ALGORITHMS)),
        *("configuration.md", "your_own.md"),
    }


def test_every_table_is_generated():
    """On the pages of figures, apart from those that explain columns."""
    for name in ("results.md", "results_archive.md", "speed.md"):
        text = re.sub(r"<!-- Generated.*?<!-- End", "", (DOCS / name).read_text(), flags=re.DOTALL)
        assert set(re.findall(r"^\|.*\|$", text, flags=re.MULTILINE)[:1]) <= {"| Column | Meaning |"}, name


@pytest.mark.parametrize("folder", ["tasks", "algorithms"])
def test_every_page_is_listed(folder):
    pages = {path.stem for path in (DOCS / folder).glob("*.md")} - {"index"}
    listed = re.search(r"```\{toctree\}\n:hidden:\n\n(.*?)\n```", (DOCS / folder / "index.md").read_text(), re.DOTALL)
    assert pages == set(listed[1].split())


def test_every_setting_has_a_meaning():
    schemas = importlib.import_module("generator.setting_tables").all_schemas()
    assert {*schemas} >= {schema for _, schema in (*TASKS.values(), *ALGORITHMS.values())} | {Config}
    for schema in schemas:
        groups = [field.default_factory for field in dataclasses.fields(schema)]
        assert {*schemas} >= {group for group in groups if dataclasses.is_dataclass(group)}, schema.__name__
        meanings = setting_fields.meanings(schema)
        missing = {row.name for row in setting_fields.table(schema)} - {*meanings, "name", "env", "algo"}
        assert not missing, schema.__name__
        assert all(meaning.endswith(".") for meaning in meanings.values())


def test_settings_of_algorithms_that_pages_name_exist():
    known = {field.name for _, schema in ALGORITHMS.values() for field in dataclasses.fields(schema)}
    named = {name for text in PAGES.values() for name in re.findall(r"`algo\.([a-z]\w+)[=`]", text)}
    assert len(named) > 30 and named <= known, named - known


def test_every_reward_term_has_its_words():
    texts = importlib.import_module("generator.task_texts").TEXTS
    assert texts.keys() == {*tasks_with_pages()}
    for name, text in texts.items():
        assert text.rewards.keys() == {term for terms in TASKS[name][0].REWARD_TERMS.values() for term in terms}
