"""Comparing: what is planned, what is kept, what is drawn."""

import csv
import json
import os
import re
import signal
import subprocess

import numpy as np
import pytest
from helpers import TINY, TINY_CALL, command, command_here, finish, start, wait_for_rows

from mjx_walk import compare as compare_command
from mjx_walk.experiments import logged_runs, planned_runs, suite
from mjx_walk.runs.config import load_config
from mjx_walk.runs.saved_config import save_config
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import format_score

SMALL = (
    *("env=walker2d", "num_envs=8", "algo.unroll_length=8", "algo.num_minibatches=2"),
    *("total_steps=512", "evaluation.num_envs=2", "evaluation.gymnasium_episodes=1", "iterations_per_call=1"),
)


def fake_run(folder, overrides, returns, score=None):
    """A run folder whose return rises along `returns`, one row a million steps and ten seconds."""
    folder.mkdir(parents=True)
    config = load_config([*overrides, f"run_dir='{folder}'"])
    save_config(config, folder / "config.yaml")
    rows = [
        {"env_steps": 1e6 * i, "wall_seconds": 10.0 * i, "episode/return": value, "episode/length": 10 * value}
        for i, value in enumerate(returns, start=1)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if score is not None:
        blocks = {"final": {"mean": score, "std": 1.0}, "best": {"mean": score + 10.0, "std": 2.0}}
        (folder / "eval_gymnasium.json").write_text(json.dumps({"env": "Walker2d-v5", **blocks}))


def test_variants_are_the_product_of_algorithms_swept_values_and_seeds(tmp_path):
    overrides = ["env=walker2d", "algo.discount=0.9,0.95", "total_steps=1000"]
    out, planned = planned_runs.plan(overrides, ["ppo", "a2c"], [0, 7], str(tmp_path / "a b's"), "cpu")
    assert out == tmp_path / "a b's"
    assert [run.name for run in planned] == [
        f"{algo}_discount-{discount}/seed_{seed}"
        for seed in (0, 7)
        for algo in ("ppo", "a2c")
        for discount in ("0.9", "0.95")
    ]
    last = planned[-1].config
    assert (last.algo.name, last.algo.discount, last.seed, last.total_steps) == ("a2c", 0.95, 7, 1000)
    assert last.run_dir == str(tmp_path / "a b's" / "a2c_discount-0.95" / "seed_7")
    num_envs = [run.config.num_envs for run in planned[:4]]
    assert num_envs == [64, 64, 256, 256]  # each with its own recipe


def test_what_is_named_twice_is_run_once(tmp_path):
    assert len(planned_runs.plan(["env=walker2d"], ["ppo", "ppo"], [0, 0, 1], str(tmp_path), "cpu")[1]) == 2


def test_variants_have_folders_of_their_own(tmp_path):
    def variants(sweep):
        planned = planned_runs.plan(["env=walker2d", sweep], ["sac"], [0], str(tmp_path), "cpu")[1]
        return [run.variant for run in planned]

    assert variants("algo.target_entropy=-0.5,0.5") == ["sac_target_entropy--0.5", "sac_target_entropy-0.5"]
    assert variants("algo.policy_hidden_layer_sizes=[32,32],[32,64]") == [
        "sac_policy_hidden_layer_sizes-_32_32_",
        "sac_policy_hidden_layer_sizes-_32_64_",
    ]
    with pytest.raises(UserError, match="would share the folder"):
        variants("env.xml_file=a:b,a/b")


def test_the_folder_is_named_after_the_environment_that_is_trained(tmp_path):
    out, _ = planned_runs.plan(["recipe=report/e_td3"], ["td3"], [0], None, "cpu")
    assert str(out) == "runs/compare_walker2d"


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
    text = suite.write_report(tmp_path).read_text()
    assert "| ppo, discount=0.99 | final | 15.0 | 7.07 | – | – | – | 2 | 2 | 3.00 | 30 |" in text
    assert "| ppo, discount=0.99 | best | 25.0 | 7.07 | – | – | – | 2 | 2 | 3.00 | 30 |" in text
    assert "| ppo, discount=0.5 | final | – | – | – | – | – | 0 | 2 | 2.00 | 20 |" in text
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
    assert run.scores.blocks["better"]["env_steps"] == 5 and run.scores.facts == {"wall_seconds": 2.0}


def test_runs_of_several_environments_are_normalized(tmp_path):
    """0 is the random score and 1 the reference, in each environment that Gymnasium scores by default."""
    for env in ("walker2d", "hopper", "ant", "reacher"):
        random, reference = suite.REFERENCES[f"{env} v5"]
        for seed in range(3):
            score = random + (seed + 1) * (reference - random)
            fake_run(tmp_path / env / str(seed), [f"env={env}", f"seed={seed}"], [1, 2], score)
    fake_run(tmp_path / "ant" / "3", ["env=ant", "seed=3"], [1, 2], 5000.0)  # not scored in the others
    text = suite.write_report(tmp_path).read_text()
    assert "| ppo | final | 2.00 | -0.48 | 4.48 | 2.00 | -0.48 | 4.48 | 4 | 3 |" in text
    assert "| reacher v5 | ppo | 32.8 | 37.9 | -61.2 | 126.9 | 42.8 | -42.9 | -5.03 | 2.00 |" in text
    assert "| ant v5 | ppo | 3 | 5,000 | 1.00 | 5,010 |" in text
    assert (tmp_path / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    assert len((tmp_path / "comparison.csv").read_text().splitlines()) == 1 + 13


def test_only_gymnasiums_own_environment_has_a_reference(tmp_path):
    fake_run(tmp_path / "a", ["env=ant", "env.healthy_reward=2"], [1], 100.0)
    fake_run(tmp_path / "b", ["env=hopper", "env.version=v4"], [1], 100.0)
    text = suite.write_report(tmp_path).read_text()
    assert "| ppo | final | – | – | – | – | – | – | 0 | 0 |" in text


def test_a_suite_has_every_environment_with_its_own_recipe(tmp_path):
    out, planned = suite.plan_suite("mujoco", [], ["ppo"], [3], str(tmp_path), "cpu")
    assert out == tmp_path and len({run.config.env.name for run in planned}) == 11 == len(planned)
    assert planned[1].name == "humanoid_standup/ppo/seed_3" and planned[1].folder.path == tmp_path / planned[1].name
    with pytest.raises(UserError, match="suite=mujoco has its own environments; leave one of both out"):
        suite.plan_suite("mujoco", ["env=ant"], ["ppo"], [0], None, "cpu")


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


@pytest.mark.slow
def test_compare_runs_what_is_missing_and_keeps_the_rest(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    arguments = ("seeds=1", "out=out", *SMALL)
    assert command_here("compare", "algos=[ppo]", *arguments) == 0
    printed = capfd.readouterr().out
    assert "1 runs in out, 0 of them finished already" in printed and "| ppo | final |" in printed
    before = (tmp_path / "out" / "ppo" / "seed_0" / "metrics.jsonl").stat().st_mtime_ns
    assert command_here("compare", "algos=[ppo,a2c]", *arguments) == 0
    printed = capfd.readouterr().out
    assert "2 runs in out, 1 of them finished already" in printed and "| a2c | final |" in printed
    assert (tmp_path / "out" / "ppo" / "seed_0" / "metrics.jsonl").stat().st_mtime_ns == before


@pytest.mark.slow
def test_an_interrupted_comparison_goes_on(tmp_path):
    arguments = ["algos=[a2c]", "seeds=1", "out=out", *SMALL, "checkpoint.every_calls=1"]
    arguments[arguments.index("total_steps=512")] = "total_steps=6400"
    process = start("compare", *arguments, cwd=tmp_path)
    run = tmp_path / "out" / "a2c" / "seed_0"
    wait_for_rows(process, run, 2)
    process.send_signal(signal.SIGINT)
    assert "Run the same command to resume" in finish(process) and process.returncode == 130
    steps = len((run / "metrics.jsonl").read_text().splitlines())
    assert 0 < steps < 100
    done = command("compare", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line)["env_steps"] for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert rows == [64 * i for i in range(1, len(rows) + 1)] and rows[-1] == 6400


BAD = [
    (["algos=[dqn]"], "algos=['dqn']: choose one of: ppo"),
    (["algos=[]"], "algos=[]: choose some of: ppo"),
    (["seeds=0"], "seeds=0: give a number of seeds, or a list of different seeds from 0 up"),
    (["seeds=[a]"], "give a number of seeds"),
    (["algo=ppo"], "'algo=ppo': in a comparison write algos=[…]"),
    (["seed=1"], "write seeds=N"),
    (["devices=99"], "devices=99: this machine has"),
    (["per_device=0"], "per_device=0: must be at least 1"),
    (["env=snake"], "unknown env 'snake'"),
    (["algo.discount=0.9,2.0"], "algo.discount=2.0: must be at most 1"),
    (["draw=true", "out=nowhere"], "no runs below 'nowhere'"),
    (["suite=atari"], "suite=atari: choose one of: mujoco"),
    (["suite=mujoco", "env=ant"], "'env=ant': suite=mujoco has its own environments; leave one of both out"),
    (["draw=true"], "say which runs to draw: out=DIR"),
    (["env=walker2d,humanoid"], "one comparison is of one environment, not of humanoid v5, walker2d v5"),
    (["env.version=v4,v5"], "one comparison is of one environment"),
    (["algo.discount=interval(0.9,0.99)"], "list the values, algo.discount=A,B"),
    (["algos=[ppo"], "algos=[ppo: "),
]


@pytest.mark.parametrize(("arguments", "says"), BAD, ids=[" ".join(case[0]) for case in BAD])
def test_compare_names_the_mistake(arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare_command, "count_devices", lambda: ("cpu", 1))
    with pytest.raises(UserError) as error:
        compare_command.main(arguments)
    assert says in str(error.value) and "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_other_settings_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare_command, "count_devices", lambda: ("cpu", 1))
    fake_run(tmp_path / "out" / "ppo" / "seed_0", ["env=walker2d", "num_envs=128"], [1])
    for change, named in (
        ("num_envs=256", "num_envs"),
        ("total_steps=5", "total_steps, which"),
        ("physics=jax", "physics"),
    ):
        with pytest.raises(UserError, match=f"holds a run with other settings \\(.*{named}.*; choose another out=DIR"):
            compare_command.main(["env=walker2d", "algos=[ppo]", "out=out", change])


def test_seeds_that_stand_at_the_same_step_are_trained_together(tmp_path):
    """Of three seeds one has a checkpoint; first ones of all variants come first."""
    _, planned = planned_runs.plan(["env=walker2d"], ["ppo", "a2c"], [0, 1, 2], str(tmp_path), "cpu")
    (tmp_path / "ppo" / "seed_1" / "checkpoints" / f"{4096:013d}").mkdir(parents=True)

    def names(together):
        return [[run.name for run in job] for job in planned_runs.jobs(planned, together)]

    assert names(3) == [["ppo/seed_0", "ppo/seed_2"], ["a2c/seed_0", "a2c/seed_1", "a2c/seed_2"], ["ppo/seed_1"]]
    assert names(2)[1:] == [["a2c/seed_0", "a2c/seed_1"], ["ppo/seed_1"], ["a2c/seed_2"]]
    assert [planned_runs.most_together(planned, slots) for slots in (1, 3, 4, 8)] == [3, 3, 2, 1]
    assert names(1)[:3] == [["ppo/seed_0"], ["a2c/seed_0"], ["ppo/seed_1"]]


class FakeProcess:
    """A run that continues until a signal stops it."""

    def __init__(self, code=None):
        self.code, self.signals = code, []

    def poll(self):
        return self.code

    def send_signal(self, number):
        self.signals.append(number)

    def wait(self):
        return self.code


def test_no_run_goes_on_alone(tmp_path, monkeypatch):
    """One of two runs ends, and what is to be done then fails."""
    _, planned = planned_runs.plan(["env=walker2d"], ["ppo"], [0, 1], str(tmp_path), "cpu")
    processes = [FakeProcess(code=0), FakeProcess()]
    monkeypatch.setattr(planned_runs, "start_job", lambda job, *_: processes[job[0].config.seed])
    with pytest.raises(ZeroDivisionError):
        planned_runs.run_jobs(planned_runs.jobs(planned, 1), [0, 1], tmp_path / "logs", lambda run, log: 1 // 0)
    assert processes[1].signals == [signal.SIGTERM]


def test_a_second_comparison_in_the_same_folder_waits_its_turn(tmp_path):
    with planned_runs._lock(tmp_path / "out" / "logs"), pytest.raises(UserError, match="still being trained"):
        planned_runs.run_jobs([], [None], tmp_path / "out" / "logs", lambda run, log: None)
    assert planned_runs.run_jobs([], [None], tmp_path / "out" / "logs", lambda run, log: None) is None


@pytest.mark.parametrize("link", ["ppo", "logs", "logs/ppo"])
def test_a_link_in_the_folder_of_a_comparison_is_refused(tmp_path, link, capsys):
    """The folder may be downloaded; nothing is written where a link in it leads."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "out" / link).parent.mkdir(parents=True)
    (tmp_path / "out" / link).symlink_to(tmp_path / "outside")
    arguments = [*TINY, "algos=[ppo]", "seeds=1", f"total_steps={TINY_CALL}", f"out={tmp_path}/out"]
    assert command_here("compare", *arguments) == 2
    assert f"{link}' is a symbolic link" in capsys.readouterr().err
    assert list((tmp_path / "outside").iterdir()) == []


def test_a_pipe_in_place_of_a_log_is_refused(tmp_path, capsys):
    (tmp_path / "logs" / "ppo").mkdir(parents=True)
    os.mkfifo(tmp_path / "logs" / "ppo" / "seed_0.txt")
    arguments = [*TINY, "algos=[ppo]", "seeds=1", f"total_steps={TINY_CALL}", f"out={tmp_path}"]
    assert command_here("compare", *arguments) == 2
    assert "seed_0.txt: it is not a regular file" in capsys.readouterr().err


def test_a_run_that_fails_is_named(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert command_here("compare", "algos=[ppo]", "seeds=1", "out=out", *SMALL, "num_envs=7") == 2
    assert "not finished: ppo/seed_0" in capfd.readouterr().err
    assert "choose num_envs a multiple of" in (tmp_path / "out" / "logs" / "ppo" / "seed_0.txt").read_text()


@pytest.mark.slow
def test_runs_spread_by_hydras_joblib_launcher_are_drawn(tmp_path):
    arguments = ["seed=0,1", "hydra/launcher=joblib", "hydra.sweep.dir=out", *SMALL]
    done = command("train", "-m", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    drawn = command("compare", "draw=true", "out=out", cwd=tmp_path)
    assert drawn.returncode == 0, drawn.stderr
    assert re.search(r"\| ppo \| final \|.*\| 2 \| 2 \| 0\.00 \|", drawn.stdout)


@pytest.mark.parametrize(("visible", "expected"), [(None, "1"), ("4,6", "6")])
def test_each_run_sees_its_own_gpu(tmp_path, monkeypatch, visible, expected):
    """Counted among those that the user lets us see."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda arguments, **kwargs: started.append((arguments, kwargs["env"])))
    _, (run,) = planned_runs.plan(["env=walker2d"], ["ppo"], [3], str(tmp_path), "gpu")
    planned_runs.start_job([run], tmp_path / "logs" / "run.txt", 1, 2, 0)
    ((arguments, environment),) = started
    assert environment["CUDA_VISIBLE_DEVICES"] == expected
    assert float(environment["XLA_PYTHON_CLIENT_MEM_FRACTION"]) <= 0.75 / 2 + 0.01
    assert "seeds=[3]" in arguments and "resume=true" not in arguments
