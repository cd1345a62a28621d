"""The archive of runs with seeds that no recipe was tuned on, and the tables made from it."""

import dataclasses
import importlib
import json
import tarfile

import numpy as np
import pytest
from helpers import CLONE

from mjx_walk.settings.config import training_command
from mjx_walk.utils.errors import UserError

DOCS = CLONE / "docs"
ARCHIVE = DOCS / "measured" / "fresh_seeds.tar.xz"


@pytest.fixture(scope="module", autouse=True)
def docs_path():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        yield


@pytest.fixture(scope="module")
def runs():
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
                algorithm = member.name.partition("/")[0].rpartition("_")[2]
                finals.setdefault((scores["env"], algorithm), []).append(np.mean(scores["final"]["returns"]))
    rows = [line.split(" | ") for line in (DOCS / "results.md").read_text().splitlines() if line.startswith("| ")]
    shown = {(cells[0].removeprefix("| "), cells[1].lower()): cells[3] for cells in rows if cells[2:3] == ["final"]}
    best = {}
    for recipe, means in finals.items():
        mean = np.mean(means)
        assert shown[recipe] == (f"{mean:,.0f}" if abs(mean) >= 1000 else f"{mean:.2f}"), recipe
        best[recipe[0]] = max(best.get(recipe[0], (-np.inf, "")), (mean, shown[recipe]))
    readme = [line.split(" | ") for line in (CLONE / "README.md").read_text().splitlines() if line.startswith("| ")]
    scores = {cells[0].removeprefix("| "): cells[2] for cells in readme if len(cells) == 8}
    assert best and {task: scores[task] for task in best} == {task: text for task, (_, text) in best.items()}


def test_the_archive_is_small_and_names_no_folder_of_a_user():
    assert ARCHIVE.stat().st_size < 20e6
    with tarfile.open(ARCHIVE) as archive:
        configs = [archive.extractfile(name).read() for name in archive.getnames() if name.endswith("config.yaml")]
    assert configs and all(b"\nrun_dir: null\n" in config for config in configs)


def contents(path):
    with tarfile.open(path) as archive:
        return [(member, archive.extractfile(member).read()) for member in archive.getnames()]


def test_adding_the_runs_of_the_archive_gives_the_same_archive(tmp_path):
    add = importlib.import_module("add_fresh_seeds").add
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    config = tmp_path / "walker2d_csac" / "seed_300" / "config.yaml"
    config.write_text(config.read_text().replace("\nrun_dir: null\n", "\nrun_dir: /home/me/run\n"))
    add([tmp_path / "walker2d_csac"], tmp_path / "one.tar.xz")
    add([tmp_path], tmp_path / "all.tar.xz")
    add([tmp_path / "walker2d_csac"], tmp_path / "all.tar.xz")
    assert contents(tmp_path / "all.tar.xz") == contents(ARCHIVE)
    assert len(contents(tmp_path / "one.tar.xz")) == 5 * 4


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("eval_gymnasium.json", '"best"', '"other"', "walker2d csac seed=300 has no score of 100 episodes"),
        ("config.yaml", "\nseed: 300\n", "\nseed: 3\n", "walker2d csac seed=3: recipes are tuned on seeds below 100"),
        ("config.yaml", "total_steps: 13000000", "total_steps: 14000000", "walker2d csac seed=300 has not ended"),
    ],
)
def test_unfinished_runs_are_not_added(file, old, new, says, tmp_path):
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    path = tmp_path / "walker2d_csac" / "seed_300" / file
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(UserError, match=says):
        importlib.import_module("add_fresh_seeds").add([path.parent], tmp_path / "new.tar.xz")
    assert not (tmp_path / "new.tar.xz").exists()
