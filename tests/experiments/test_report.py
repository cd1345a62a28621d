"""The report on runs: what is grouped, counted, normalized and drawn."""

import csv
import json

import numpy as np
import pytest
from fake_runs import fake_run

from mjx_walk.envs import TASKS, make_options
from mjx_walk.experiments import logged_runs, report, suite
from mjx_walk.utils.text import format_score


def test_runs_are_grouped_by_what_sets_them_apart(tmp_path):
    for seed, score in ((0, 10.0), (1, 20.0)):
        fake_run(tmp_path / f"x{seed}", ["env=walker2d", f"seed={seed}"], [1, 2, 3], score)
        fake_run(tmp_path / "sweep" / str(seed), ["env=walker2d", f"seed={seed}", "algo.discount=0.5"], [0, 1])
    fake_run(tmp_path / "other", ["env=walker2d", "algo=a2c"], [5])
    fake_run(tmp_path / "engine", ["env=walker2d", "algo=a2c", "physics=jax"], [5])
    groups = logged_runs.group(logged_runs.read_runs(tmp_path))
    assert {label: len(runs) for label, runs in groups.items()} == {
        "a2c, physics=auto": 1,
        "a2c, physics=jax": 1,
        "ppo, discount=0.99": 2,
        "ppo, discount=0.5": 2,
    }
    text = report.write_report(tmp_path).read_text()
    assert "| ppo, discount=0.99 | final | 15.0 | 7.07 | 10.0 | – | – | – | 2 | 2 | 3.00 | 30 |" in text
    assert "| ppo, discount=0.99 | best | 25.0 | 7.07 | 20.0 | – | – | – | 2 | 2 | 3.00 | 30 |" in text
    assert "| ppo, discount=0.5 | final | – | – | – | – | – | – | 0 | 2 | 2.00 | 20 |" in text
    assert "| ppo, discount=0.99 | 1 | 20.0 | 1.00 | 30.0 | 2.00 | 3.00 | 30 | 1 |" in text
    rows = list(csv.DictReader((tmp_path / "comparison.csv").open()))
    assert len(rows) == 6 and {row["final_mean"] for row in rows} == {"10.0", "20.0", ""}
    assert {row["best_mean"] for row in rows} == {"20.0", "30.0", ""}
    assert (tmp_path / "comparison.png").read_bytes()[:4] == b"\x89PNG"


def test_scores_that_cannot_be_read_cost_the_comparison_nothing_else(tmp_path):
    for seed in (0, 1):
        fake_run(tmp_path / str(seed), ["env=walker2d", f"seed={seed}"], [1, 2], score=5.0)
    for damaged in ('{"mean": 5', "[]", '{"final": 3}', "{}"):
        (tmp_path / "0" / "eval_gymnasium.json").write_text(damaged)
        with pytest.warns(UserWarning, match=r"eval_gymnasium\.json cannot be read: score the run again"):
            runs = logged_runs.read_runs(tmp_path)
        assert [run.score("final").get("mean") for run in runs] == [None, 5.0]


def test_a_score_file_of_one_block_counts_as_the_best(tmp_path):
    fake_run(tmp_path / "0", ["env=walker2d"], [1, 2])
    content = {"env": "Walker2d-v5", "mean": 7.0, "std": 1.0, "returns": [7.0], "lengths": [3], "seeds": [0]}
    (tmp_path / "0" / "eval_gymnasium.json").write_text(json.dumps(content | {"env_steps": 5, "wall_seconds": 2.0}))
    (run,) = logged_runs.read_runs(tmp_path)
    assert run.score("final") == {} and run.score("best")["mean"] == 7.0
    assert run.scores.blocks["better"]["env_steps"] == 5 and run.scores.metadata == {"wall_seconds": 2.0}


def test_runs_of_several_environments_are_normalized(tmp_path):
    """0 is the random score and 1 the reference, in each environment that Gymnasium scores by default."""
    for env in ("walker2d", "hopper", "ant", "reacher"):
        random, reference = suite.REFERENCES[TASKS[env][0].id_of(make_options(env))]
        for seed in range(3):
            score = random + (seed + 1) * (reference - random)
            fake_run(tmp_path / env / str(seed), [f"env={env}", f"seed={seed}"], [1, 2], score)
    fake_run(tmp_path / "ant" / "3", ["env=ant", "seed=3"], [1, 2], 5000.0)  # not scored in the others
    text = report.write_report(tmp_path).read_text()
    assert "| ppo | final | 2.00 | -0.48 | 4.48 | 2.00 | -0.48 | 4.48 | 4 | 3 |" in text
    assert "| Reacher-v5 | ppo | 32.8 | 37.9 | -5.03 | -61.2 | 126.9 | 42.8 | -42.9 | -5.03 | 2.00 |" in text
    assert "| Ant-v5 | ppo | 3 | 5,000 | 1.00 | 5,010 |" in text
    assert (tmp_path / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    assert len((tmp_path / "comparison.csv").read_text().splitlines()) == 1 + 13


def test_the_last_table_has_returns_at_equal_steps_and_seconds(tmp_path):
    """Evaluations of policies of 0.5M and 5.5M steps."""
    for seed, last in ((0, 900.0), (1, 1100.0)):
        fake_run(tmp_path / str(seed), ["env=walker2d", f"seed={seed}"], [1, 2, 3, 4, 5, 6])
        path = tmp_path / str(seed) / "metrics.jsonl"
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        rows[1] |= {"eval/env_steps": 5e5, "eval/return": 100.0}
        rows[5] |= {"eval/env_steps": 5.5e6, "eval/return": last}
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    text = report.write_report(tmp_path).read_text()
    # 1M and 5M steps: 100 + 0.1 · 900 and 100 + 0.9 · 900, of the mean of both seeds. The log begins after 10 s.
    assert "| variant | 1M steps | 5M steps | 20M steps | 60 s | 120 s | 300 s |" in text
    assert "| ppo | 190.0 | 910.0 | – | – | – | – |" in text


def test_only_gymnasiums_own_environment_has_a_reference(tmp_path):
    fake_run(tmp_path / "a", ["env=ant", "env.healthy_reward=2"], [1], 100.0)
    fake_run(tmp_path / "b", ["env=hopper", "env.version=v4"], [1], 100.0)
    text = report.write_report(tmp_path).read_text()
    assert "| ppo | final | – | – | – | – | – | – | 0 | 0 |" in text


def test_scores_keep_three_digits():
    assert [format_score(x) for x in (13_310.4, 143.66, -30.3, -3.94, 0.0, None)] == [
        "13,310",
        "143.7",
        "-30.3",
        "-3.94",
        "0.00",
        "–",
    ]


def test_mean_curve_is_drawn_where_all_seeds_are():
    x, mean, values = logged_runs.mean_curve(
        [(np.array([0.0, 4.0]), np.array([0.0, 8.0])), (np.array([2.0, 6.0]), np.array([1.0, 1.0]))]
    )
    assert (x[0], x[-1]) == (2.0, 4.0) and values.shape == (2, len(x))
    np.testing.assert_allclose(mean, (2.0 * x + 1.0) / 2.0)
    apart = logged_runs.mean_curve([(np.array([0.0, 1.0]), np.ones(2)), (np.array([2.0, 3.0]), np.ones(2))])
    assert apart[0].size == 0


def test_intervals_from_three_seeds_up_cover_the_mean():
    assert logged_runs.interval(np.arange(2.0)) is None
    for num_seeds in (3, 5, 10):
        low, high = logged_runs.interval(np.random.default_rng(0).normal(10.0, 2.0, (num_seeds, 20_000)))
        assert low.shape == (20_000,)
        assert ((low < 10.0) & (high > 10.0)).mean() == pytest.approx(0.95, abs=0.005)
