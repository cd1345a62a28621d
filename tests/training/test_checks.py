"""A run folder is used by one training at a time, and can be used again if the run never began."""

import dataclasses
import subprocess

import pytest

from mjx_walk.settings.config import load_config
from mjx_walk.storage import checkpoint
from mjx_walk.training.checks import prepared
from mjx_walk.utils.errors import UserError


@pytest.fixture(scope="module")
def config():
    return load_config(["env=walker2d", "hardware=cpu"])


@pytest.fixture
def here(config, tmp_path):
    return dataclasses.replace(config, run_dir=str(tmp_path / "run"))


def test_a_second_training_is_refused_until_the_first_has_ended(here):
    again = dataclasses.replace(here, resume=True)
    for first in (here, again):
        with prepared([first]):
            for config in (again, dataclasses.replace(again, total_steps=10**9)):
                with pytest.raises(UserError, match="run is in use by another training run; wait for it, or stop it"):
                    prepared([config]).__enter__()
    with pytest.raises(UserError, match="holds a run already"):
        prepared([here]).__enter__()


def test_a_seed_that_is_in_use_frees_the_others(here, tmp_path):
    seeds = [dataclasses.replace(here, seed=seed, run_dir=str(tmp_path / f"seed_{seed}")) for seed in (0, 1)]
    with prepared([seeds[1]]), pytest.raises(UserError, match="seed_1"):
        prepared(seeds).__enter__()
    with prepared([seeds[0]]) as (folders, _):
        assert folders[0].config.exists()


def test_a_link_may_lead_to_the_folder_of_the_runs(config, tmp_path):
    (tmp_path / "disk" / "x").mkdir(parents=True)
    (tmp_path / "runs").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "link").symlink_to(tmp_path / "disk" / "x")
    for run_dir in ("runs/run", "runs/link"):
        with prepared([dataclasses.replace(config, run_dir=f"{tmp_path}/{run_dir}")]) as (folders, _):
            checkpoint.save(folders[0].policy("best"), {"a": 1.0}, {"env_steps": 0})
        assert (tmp_path / run_dir / "config.yaml").exists()


def test_a_child_process_that_lives_on_does_not_keep_the_lock(here):
    with prepared([here]):
        child = subprocess.Popen(["cat"], stdin=subprocess.PIPE)
    with child, prepared([dataclasses.replace(here, resume=True)]) as (folders, _):
        assert folders[0].is_run
        child.stdin.close()


LEFT = ([], [".lock"], [".lock", "checkpoints/"], ["checkpoints/", ".config.0123456789abcdef.yaml"])


@pytest.mark.parametrize("left", LEFT)
@pytest.mark.parametrize("is_empty_config", [False, True])
def test_a_run_that_ended_before_it_had_a_configuration_can_begin_again(here, tmp_path, left, is_empty_config):
    (tmp_path / "run").mkdir()
    for name in left:
        path = tmp_path / "run" / name
        path.mkdir() if name.endswith("/") else path.write_text("half" if "config" in name else "")
    if is_empty_config:
        (tmp_path / "run" / "config.yaml").touch()
    with prepared([here]) as (folders, _):
        assert folders[0].config.stat().st_size > 0
        assert sorted(path.name for path in folders[0].path.iterdir()) == [".lock", "checkpoints", "config.yaml"]


@pytest.mark.parametrize("name", ["chapter.tex", "checkpoints/0000000000064/", ".lock/", ".config"])
def test_a_folder_with_anything_else_is_left_alone(here, tmp_path, name):
    path = tmp_path / "run" / name
    path.mkdir(parents=True) if name.endswith("/") else (path.parent.mkdir(), path.write_text("work"))
    with pytest.raises(UserError, match="exists and is not a run folder"):
        prepared([here]).__enter__()
    assert not (tmp_path / "run" / "config.yaml").exists()
