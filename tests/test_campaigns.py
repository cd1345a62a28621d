"""Campaigns of minutes, run by CI after the fast tests."""

import json

import pytest
from commands import command

from mjx_walk import parity
from mjx_walk.envs import TASKS

pytestmark = pytest.mark.slow


def test_walker2d_walks_after_the_cpu_recipe(tmp_path):
    """The command a user without a GPU types, with its score in the real Gymnasium."""
    done = command("train", "env=walker2d", f"run_dir={tmp_path}/run", timeout=1800)
    assert done.returncode == 0, done.stderr
    scores = json.loads((tmp_path / "run" / "eval_gymnasium.json").read_text())
    assert scores["mean"] >= 2000 and len(scores["returns"]) == 100


@pytest.mark.parametrize("physics", ["jax", "warp"])
@pytest.mark.parametrize("version", ["v5", "v4"])
@pytest.mark.parametrize("name", TASKS)
def test_parity_of_all_versions(name, version, physics):
    found = parity.check(name, version, physics, num_copies=48, num_steps=120)
    assert found.is_within, "\n".join(map(str, found.errors))


@pytest.mark.parametrize("physics", ["jax", "warp"])
def test_humanoid_trains_through_mjx(tmp_path, physics):
    """A small batch, from the command to the score, on each MJX engine."""
    small = (
        "num_envs=16",
        "evaluation.num_envs=2",
        "total_steps=4096",
        "algo.unroll_length=16",
        "env.max_episode_steps=50",
    )
    minibatches = ("algo.num_minibatches=4", "algo.num_epochs=2", "evaluation.gymnasium_episodes=4")
    done = command("train", f"physics={physics}", f"run_dir={tmp_path}/run", *small, *minibatches)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 16 and all(row["physics/nonfinite"] == row["physics/overflow"] == 0 for row in rows)
    assert "In the real Gymnasium, Humanoid-v5" in done.stdout
