"""Comparing: what is planned, what is kept, what is drawn."""

import json
import os
import re
import signal
import subprocess

import pytest
from fake_runs import fake_run
from helpers import TINY, TINY_CALL, command, command_here, finish, start, wait_for_rows

from mjx_walk import compare as compare_command
from mjx_walk.experiments import planned_runs, slots, suite
from mjx_walk.experiments.job_logs import failure_reason
from mjx_walk.utils.errors import UserError

SMALL = (
    *("env=walker2d", "num_envs=8", "algo.unroll_length=8", "algo.num_minibatches=2"),
    *("total_steps=512", "evaluation.num_envs=2", "evaluation.gymnasium_episodes=1", "iterations_per_call=1"),
)


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


def test_a_suite_has_every_environment_with_its_own_recipe(tmp_path):
    out, planned = suite.plan_suite("mujoco", [], ["ppo"], [3], str(tmp_path), "cpu")
    assert out == tmp_path and len({run.config.env.name for run in planned}) == 11 == len(planned)
    assert planned[1].name == "humanoid_standup/ppo/seed_3" and planned[1].folder.path == tmp_path / planned[1].name
    with pytest.raises(UserError, match="suite=mujoco has its own environments; leave out one of the two"):
        suite.plan_suite("mujoco", ["env=ant"], ["ppo"], [0], None, "cpu")


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
    (["algo=ppo"], "'algo=ppo': in a comparison write 'algos=[ppo]'"),
    (["seed=1"], "'seed=1': in a comparison write seeds=[1]"),
    (["devices=99"], "devices=99: this machine has"),
    (["per_device=0"], "per_device=0: must be at least 1"),
    (["env=snake"], "unknown env 'snake'"),
    (["algo.discount=0.9,2.0"], "algo.discount=2.0: must be at most 1"),
    (["draw=true", "out=nowhere"], "no runs below 'nowhere'"),
    (["suite=atari"], "suite=atari: choose one of: mujoco"),
    (["suite=mujoco", "env=ant"], "'env=ant': suite=mujoco has its own environments; leave out one of the two"),
    (["draw=true"], "say which runs to draw: out=DIR"),
    (["env=walker2d,humanoid"], "a comparison has one environment; give one of them, or suite=mujoco for all"),
    (["env.version=v4,v5"], "a comparison has one environment; these are several: humanoid v4, humanoid v5"),
    (["algo.discount=interval(0.9,0.99)"], "list the values, algo.discount=A,B"),
    (["algos=[ppo"], "algos=[ppo: "),
]


@pytest.mark.parametrize(("arguments", "says"), BAD, ids=[" ".join(case[0]) for case in BAD])
def test_compare_names_the_mistake(arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(slots, "count_devices", lambda: ("cpu", 1))
    with pytest.raises(UserError) as error:
        compare_command.main(arguments)
    assert says in str(error.value) and "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_other_settings_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(slots, "count_devices", lambda: ("cpu", 1))
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


@pytest.mark.parametrize(
    ("log", "reason"),
    [
        ("Training …\nerror: no space\n", "no space"),
        ("Traceback (most recent call last):\n  …\njaxlib.XlaRuntimeError: no\n", "jaxlib.XlaRuntimeError: no"),
        ("XlaRuntimeError: RESOURCE_EXHAUSTED: 5 GB\n", "memory ran out, so try together=1"),
        ("Training …\n", ""),
    ],
)
def test_the_reason_of_a_failure_is_the_last_line_of_its_log(tmp_path, log, reason):
    (tmp_path / "log.txt").write_text(log)
    assert failure_reason(tmp_path / "log.txt", "so try together=1") == reason


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
    printed = capfd.readouterr()
    assert "not finished: ppo/seed_0" in printed.err
    assert "ppo/seed_0: not finished: num_envs=7 times algo.num_unrolls=1 must be a multiple of" in printed.out
    assert "choose num_envs a multiple of" in (tmp_path / "out" / "logs" / "ppo" / "seed_0.txt").read_text()


@pytest.mark.slow
def test_runs_spread_by_hydras_joblib_launcher_are_drawn(tmp_path, monkeypatch, capfd):
    arguments = ["seed=0,1", "hydra/launcher=joblib", "hydra.sweep.dir=out", *SMALL]
    done = command("train", "-m", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    monkeypatch.chdir(tmp_path)
    assert command_here("compare", "draw=true", "out=out") == 0
    assert re.search(r"\| ppo \| final \|.*\| 2 \| 2 \| 0\.00 \|", capfd.readouterr().out)


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
