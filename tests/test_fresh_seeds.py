"""The archive of runs with seeds that no recipe was tuned on, and the tables made from it."""

import dataclasses
import importlib
import json
import tarfile

import numpy as np
import pytest
from helpers import CLONE

from mjx_walk.settings.config import training_command

DOCS = CLONE / "docs"
ARCHIVE = DOCS / "measured" / "fresh_seeds.tar.xz"


@pytest.fixture(scope="module")
def runs():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        return importlib.import_module("generator.fresh_seeds").runs()


def test_every_seed_has_100_episodes_of_both_policies(runs):
    seeds = {}
    for run in runs:
        seeds.setdefault((run.task, run.config.algo.name), []).append(run.config.seed)
        returns = [run.score(policy)["returns"] for policy in ("final", "best")]
        assert [len(of_policy) for of_policy in returns] == [100, 100], run.task
    assert set(map(tuple, seeds.values())) == {(300, 301, 302, 303, 304)}


def test_the_recipes_are_the_ones_that_were_trained(runs):
    """A recipe on which figures stand does not change without new runs."""
    for run in runs:
        name, algo, seed = run.config.env.name, run.config.algo.name, run.config.seed
        command = training_command(dataclasses.replace(run.config, physics="auto"))
        assert command == f"python -m mjx_walk.train env={name} algo={algo} seed={seed}"


def test_the_pages_show_the_means_of_the_archive():
    finals = {}
    with tarfile.open(ARCHIVE) as archive:
        for member in archive.getmembers():
            if member.name.endswith("eval_gymnasium.json"):
                scores = json.load(archive.extractfile(member))
                finals.setdefault(scores["env"], []).append(np.mean(scores["final"]["returns"]))
    readme = [line.split(" | ") for line in (CLONE / "README.md").read_text().splitlines() if line.startswith("| ")]
    shown = {cells[0].removeprefix("| "): cells[2] for cells in readme if len(cells) == 8}
    for task, means in finals.items():
        assert shown[task] == f"{np.mean(means):,.0f}"


def test_the_archive_is_small_and_names_no_folder_of_a_user():
    assert ARCHIVE.stat().st_size < 20e6
    with tarfile.open(ARCHIVE) as archive:
        configs = [archive.extractfile(name).read() for name in archive.getnames() if name.endswith("config.yaml")]
    assert configs and all(b"\nrun_dir: null\n" in config for config in configs)
