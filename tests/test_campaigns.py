"""Campaigns of minutes. CI runs all but the long ones after the fast tests."""

import json
import signal

import pytest
from helpers import command, finish, start, wait_for_row

pytestmark = pytest.mark.slow

AS_A_USER = {"XLA_FLAGS": ""}
"""Compiled as XLA does unasked, which `conftest` doesn't wait for elsewhere."""

SHORTER = {
    "ppo": ("total_steps=150000",),
    "td3": ("total_steps=100000",),
}


@pytest.mark.parametrize(
    ("env", "algo", "least", "enough"),
    [
        ("inverted_pendulum", "ppo", 950, 999),
        pytest.param("inverted_pendulum", "a2c", 950, 999, marks=pytest.mark.long),
        pytest.param("walker2d", "td3", 400, 600, marks=pytest.mark.long),
    ],
)
def test_a_policy_is_good_after_the_cpu_recipe(tmp_path, env, algo, least, enough):
    """The command that a user without a GPU types, stopped by SIGTERM once an evaluation is clearly above the mark.

    After one call, a walker scores about 300 in Gymnasium.
    """
    arguments = (f"env={env}", f"algo={algo}", *SHORTER.get(algo, ()), "evaluation.gymnasium_episodes=0")
    process = start("train", *arguments, f"run_dir={tmp_path}/run", seconds=2400, env=AS_A_USER)
    wait_for_row(process, tmp_path / "run", lambda row: row.get("eval/return", 0.0) >= enough)
    process.send_signal(signal.SIGTERM)
    printed = finish(process)
    assert process.returncode in (0, 128 + signal.SIGTERM), printed
    done = command("eval", f"run={tmp_path}/run", "policy=best", env=AS_A_USER)
    assert done.returncode == 0, done.stderr
    best = json.loads((tmp_path / "run" / "eval_gymnasium.json").read_text())["best"]
    assert best["mean"] >= least and len(best["returns"]) == 100


OWN = {
    "ppo": ("algo.num_minibatches=4", "algo.num_epochs=2"),
    "sac": ("algo.grad_updates_per_step=1", "algo.batch_size=64", "algo.learning_starts=256", "iterations_per_call=1"),
}


@pytest.mark.parametrize(
    ("env", "algo", "physics"),
    [("walker2d", "ppo", "jax"), pytest.param("humanoid", "sac", "warp", marks=pytest.mark.long)],
)
def test_training_through_mjx(tmp_path, env, algo, physics):
    """A small batch, from the command to the score, on each MJX engine. `jax` takes minutes to compile a humanoid."""
    small = ("num_envs=16", "evaluation.num_envs=2", "total_steps=1024", "algo.unroll_length=16")
    ends = ("env.max_episode_steps=50", "evaluation.gymnasium_episodes=4", f"run_dir={tmp_path}/run")
    done = command("train", f"env={env}", f"algo={algo}", f"physics={physics}", *small, *ends, *OWN[algo])
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 4 and all(row["physics/nonfinite"] == row["physics/overflow"] == 0 for row in rows)
    assert f"), {env.capitalize()}-v5: " in done.stdout
