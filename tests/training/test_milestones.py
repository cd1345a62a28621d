"""Policies of intermediate quality: which ones a training keeps, and that a resume keeps the same."""

import json
import shutil
import signal

import jax
import numpy as np
import pytest
from helpers import TINY, TINY_CALL, command_here, leaves, saved_leaves, train_here
from shared_programs import shared_programs

from mjx_walk import api
from mjx_walk.evaluation.saved_policies import SavedPolicy, choose_policy
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.milestones import Snapshots, find_milestones, milestone_line
from mjx_walk.utils.errors import UserError

SETTINGS = ("checkpoint.milestones=true", "env.max_episode_steps=8", "algo.learning_rate=0.01")


def curve(returns):
    """A snapshot every ten steps, of policies whose only parameter is their return."""
    snapshots = Snapshots()
    for i, value in enumerate(returns):
        snapshots.take((np.float64(value),), 10 * i)
    return snapshots


def find(returns, best_return):
    """The milestones' returns and fractions, and how many policies were evaluated."""
    evaluated = []

    def mean_return(policy):
        evaluated.append(float(policy[0]))
        return evaluated[-1]

    best = {"env_steps": 10 * len(returns), "eval_return": best_return}
    found = find_milestones(curve(returns), best, mean_return)
    assert len({*evaluated}) == len(evaluated)
    return {name: (facts["eval_return"], round(facts["fraction"], 2)) for name, (_, facts) in found.items()}, evaluated


def test_fractions_are_of_the_way_from_the_first_return():
    """Pusher's returns are negative."""
    found, evaluated = find(np.linspace(-148, -22, 31), -22.0)
    assert abs(found["medium"][1] - 2 / 3) < 0.1 and abs(found["simple"][1] - 1 / 3) < 0.1
    assert len(evaluated) <= 12


def test_a_search_that_ends_at_a_jump_looks_around_it():
    found, _ = find([0, 1, 60, 2, 3, 95, 96, 97], 100.0)
    assert found["medium"] == (60, 0.6)


def test_a_policy_after_the_best_one_may_be_the_nearest():
    """The best one may have come early, and suddenly."""
    best = {"env_steps": 25, "eval_return": 100.0}
    found = find_milestones(curve([0, 1, 2, 100, 90, 65, 64]), best, lambda policy: float(policy[0]))
    assert found["medium"][1] == {"env_steps": 50, "eval_return": 65.0, "fraction": 0.65}


def test_a_line_says_where_each_is_and_which_ones_are_far():
    near = {"medium": ((), {"env_steps": 9000, "fraction": 0.6}), "simple": ((), {"env_steps": 5, "fraction": 0.3})}
    assert milestone_line(near) == (
        "Milestones from the first to the best evaluation: medium (step 9,000) at 60% of the way, "
        "simple (step 5) at 30% of the way"
    )
    far = near | {"medium": ((), {"env_steps": 9000, "fraction": 1.0})}
    assert milestone_line(far).endswith("No snapshot was found nearer to 67%; a lower iterations_per_call keeps more")
    assert milestone_line({}) == "No milestones are kept: the best policy is not better than the first one"


def test_there_are_none_on_a_way_down():
    assert find([5, 4, 3], 5.0)[0] == {} and find([], 5.0) == ({}, [])


def test_snapshots_are_few_and_dense_at_the_beginning():
    snapshots = curve(range(1000))
    steps = np.array(snapshots.env_steps) // 10
    assert len(steps) == 32 and steps[0] == 0 and steps[-1] == 999
    assert steps[3] < 20 and max(np.diff(steps)) < 120
    assert [float(policy[0]) for policy in snapshots.policies] == steps.tolist()


@pytest.fixture(scope="module")
def six_calls(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "full"
    with shared_programs():
        train_here(run_dir, *SETTINGS, f"total_steps={6 * TINY_CALL}")
    return run_dir


def milestones(run_dir):
    folders = [run_dir / "checkpoints" / name for name in ("best", "medium", "simple")]
    return [(json.loads((folder / "meta.json").read_text()), saved_leaves(folder)) for folder in folders]


def assert_same_milestones(run_dir, expected_dir):
    for (facts, found), (expected_facts, expected) in zip(milestones(run_dir), milestones(expected_dir), strict=True):
        for name in ("checksum", "config_crc32"):  # of the configuration, which names the folder
            del facts[name], expected_facts[name]
        assert facts == expected_facts and found.keys() == expected.keys()
        jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_a_training_keeps_policies_between_the_first_and_the_best(six_calls):
    best, medium, simple = [facts for facts, _ in milestones(six_calls)]
    assert simple["eval_return"] <= medium["eval_return"] <= best["eval_return"]
    assert {simple["env_steps"], medium["env_steps"]} <= {i * TINY_CALL for i in range(7)}
    policy = SavedPolicy(RunFolder(six_calls), policy="medium")
    assert policy.policy_name == "medium" and policy.policy_metadata["fraction"] == medium["fraction"]


def test_a_training_that_was_stopped_keeps_the_same_policies(tmp_path, six_calls, monkeypatch):
    run_dir, arguments = tmp_path / "run", (*TINY, *SETTINGS, f"total_steps={6 * TINY_CALL}")

    def take(snapshots, policy_params, env_steps):
        real(snapshots, policy_params, env_steps)
        if env_steps == 3 * TINY_CALL:
            signal.raise_signal(signal.SIGTERM)

    real = Snapshots.take
    with monkeypatch.context() as patched, shared_programs():
        patched.setattr(Snapshots, "take", take)
        assert command_here("train", *arguments, f"run_dir={run_dir}") == 143
    with pytest.raises(UserError, match=r"run has no medium policy; .* checkpoint.milestones=true"):
        choose_policy(RunFolder(run_dir), "medium")
    train_here(run_dir, "resume=true", tiny=[])
    assert_same_milestones(run_dir, six_calls)
    full, resumed = leaves(six_calls, 6), leaves(run_dir, 6)
    assert full.keys() == resumed.keys() and any(name.startswith("snapshots.") for name in full)
    for name, leaf in full.items():
        np.testing.assert_array_equal(leaf, resumed[name], err_msg=name)


def test_a_longer_training_removes_the_former_milestones(tmp_path, six_calls, monkeypatch):
    run_dir = shutil.copytree(six_calls, tmp_path / "run")
    monkeypatch.setattr("mjx_walk.training.trainer.closing_policies", lambda *_: 1 / 0)
    with shared_programs(), pytest.raises(ZeroDivisionError):
        api.train([api.resolve([f"run_dir={run_dir}", "resume=true", f"total_steps={8 * TINY_CALL}"])])
    assert sorted(path.name for path in (run_dir / "checkpoints").glob("[a-z]*")) == ["best", "final"]


def test_damaged_snapshots_leave_the_run_without_milestones(tmp_path, six_calls):
    path = checkpoint.step_path(six_calls / "checkpoints", 6 * TINY_CALL)
    like = SavedPolicy(RunFolder(six_calls)).policy_params
    metadata = checkpoint.read_meta(path)
    assert len(Snapshots.restore(path, metadata, like).policies) == 7
    damaged = shutil.copytree(path, tmp_path / path.name)
    shutil.rmtree(damaged / "snapshots")
    with pytest.warns(UserWarning, match="damaged: .*; the run keeps no milestones"):
        assert Snapshots.restore(damaged, metadata, like) is None


def test_a_damaged_milestone_is_no_other_policy(tmp_path, six_calls):
    run_dir = shutil.copytree(six_calls, tmp_path / "run")
    (run_dir / "checkpoints" / "medium" / "meta.json").write_text("{")
    with pytest.raises(UserError, match="medium is damaged"):
        SavedPolicy(RunFolder(run_dir), policy="medium")
