"""Several seeds side by side in one program are the runs that they would be one by one."""

import json

import numpy as np
import pytest
from commands import TINY, TINY_CHUNK, TINY_OFF_POLICY
from test_resume import leaves, train

SEEDS = "seeds=[3,5]"


def assert_alike(run, other, exactly):
    assert run.keys() == other.keys() and len(run) > 50
    for name, leaf in run.items():
        if exactly or not np.issubdtype(np.asarray(leaf).dtype, np.floating):
            np.testing.assert_array_equal(leaf, other[name], err_msg=name)
        else:
            np.testing.assert_allclose(leaf, other[name], rtol=1e-2, atol=1e-2, err_msg=name)


@pytest.mark.parametrize(("algo", "tiny"), [("ppo", TINY), ("sac", TINY_OFF_POLICY)])
def test_seeds_side_by_side_are_the_runs_of_each(tmp_path, algo, tiny):
    settings = [f"algo={algo}", f"total_steps={2 * TINY_CHUNK}"]
    train(tmp_path / "both", *settings, SEEDS, "evaluation.gymnasium_episodes=1", tiny=tiny)
    train(tmp_path / "alone", *settings, "seed=5", tiny=tiny)
    both = {seed: leaves(tmp_path / "both" / f"seed_{seed}", 2) for seed in (3, 5)}
    assert_alike(both[5], leaves(tmp_path / "alone", 2), exactly=False)
    assert not np.array_equal(both[3]["env.live.env.physics.qpos"], both[5]["env.live.env.physics.qpos"])
    rows = [
        [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        for run in (tmp_path / "both" / "seed_5", tmp_path / "alone")
    ]
    for together, alone in zip(*rows, strict=True):
        assert together.keys() == alone.keys() and together["env_steps"] == alone["env_steps"]
        assert together["episode/count"] == alone["episode/count"]
    scores = [json.loads((tmp_path / "both" / f"seed_{seed}" / "eval_gymnasium.json").read_text()) for seed in (3, 5)]
    assert [score["seeds_together"] for score in scores] == [2, 2] and scores[0]["mean"] != scores[1]["mean"]


def test_seeds_side_by_side_resume_exactly_and_each_may_go_on_alone(tmp_path):
    train(tmp_path / "whole", f"total_steps={4 * TINY_CHUNK}", SEEDS)
    train(tmp_path / "halves", f"total_steps={2 * TINY_CHUNK}", SEEDS)
    further = (f"total_steps={4 * TINY_CHUNK}", "resume=true")
    train(tmp_path / "halves", *further, SEEDS, tiny=[])
    for seed in (3, 5):
        whole, halves = (leaves(tmp_path / name / f"seed_{seed}", 4) for name in ("whole", "halves"))
        assert_alike(whole, halves, exactly=True)
    train(tmp_path / "one", f"total_steps={2 * TINY_CHUNK}", SEEDS)
    train(tmp_path / "one" / "seed_5", *further, tiny=[])
    assert_alike(leaves(tmp_path / "whole" / "seed_5", 4), leaves(tmp_path / "one" / "seed_5", 4), exactly=False)
    with pytest.raises(AssertionError, match=r"error: the seeds stand at different steps \(128, 256\); resume"):
        train(tmp_path / "one", f"total_steps={6 * TINY_CHUNK}", "resume=true", SEEDS, tiny=[])
