"""Training stopped and resumed in a new process equals training that never stopped, bit for bit."""

import errno
import functools
import json
import pickle
import shutil
import signal
import subprocess

import numpy as np
import pytest
from helpers import (
    OFF_POLICY,
    OLD_RUNS,
    ON_POLICY,
    TINY,
    TINY_CALL,
    TINY_OFF_POLICY,
    command_here,
    finish,
    flip_a_byte,
    leaves,
    slow_except,
    start,
    train,
    train_here,
    wait_for_rows,
)
from shared_programs import shared_programs

from mjx_walk.api import resolve
from mjx_walk.machine.subprocesses import start_module
from mjx_walk.storage import checkpoint
from mjx_walk.training import scoring

TASK = {"c": "env=walker2d", "jax": "env=inverted_pendulum", "warp": "env=walker2d"}
"""Without contacts, the `jax` engine compiles in a fraction of the time."""


@pytest.fixture(autouse=True)
def _programs_are_shared():
    with shared_programs():
        yield


@pytest.fixture(scope="module")
def six_calls(tmp_path_factory):
    """A run of six uninterrupted calls, by engine."""

    @functools.cache
    def on(physics):
        run_dir = tmp_path_factory.mktemp("runs") / physics
        train_here(run_dir, TASK[physics], f"physics={physics}", f"total_steps={6 * TINY_CALL}")
        return run_dir

    return on


@pytest.fixture
def two_calls(tmp_path, scored_run):
    """A run of two calls that is finished and scored."""
    return shutil.copytree(scored_run, tmp_path / "run")


@pytest.fixture(scope="module")
def scored_run(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "scored"
    train_here(run_dir, f"total_steps={2 * TINY_CALL}", "evaluation.gymnasium_episodes=1")
    return run_dir


@pytest.mark.parametrize(
    "physics", [*slow_except(["c"], ["c", "warp"]), pytest.param("jax", marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_n_and_n_calls_equal_2n(tmp_path, physics, six_calls):
    half = (f"total_steps={3 * TINY_CALL}", f"algo.schedule_steps={6 * TINY_CALL}")
    train_here(tmp_path / "halves", TASK[physics], f"physics={physics}", *half)
    train(tmp_path / "halves", "resume=true", f"total_steps={6 * TINY_CALL}", tiny=[])
    full, halves = leaves(six_calls(physics), 6), leaves(tmp_path / "halves", 6)
    assert full.keys() == halves.keys() and len(full) > 50
    for name, leaf in full.items():
        np.testing.assert_array_equal(leaf, halves[name], err_msg=name)
    assert not np.array_equal(
        full["params.policy.params.hidden_0.kernel"],
        leaves(tmp_path / "halves", 3)["params.policy.params.hidden_0.kernel"],
    )
    rows = [json.loads(line) for line in (tmp_path / "halves" / "metrics.jsonl").read_text().splitlines()]
    assert [row["env_steps"] for row in rows] == [i * TINY_CALL for i in range(1, 7)]
    seconds = [row["wall_seconds"] for row in rows]
    assert seconds == sorted(seconds)


@pytest.mark.slow
@pytest.mark.parametrize("algo", OFF_POLICY)
def test_off_policy_resume_is_exact_with_the_replay(tmp_path, algo):
    """The first half ends after the replay has gone round, with truncated episodes in it."""
    train_here(tmp_path / "full", f"algo={algo}", f"total_steps={9 * TINY_CALL}", tiny=TINY_OFF_POLICY)
    half = (f"total_steps={5 * TINY_CALL}", f"algo.schedule_steps={9 * TINY_CALL}")
    train_here(tmp_path / "halves", f"algo={algo}", *half, tiny=TINY_OFF_POLICY)
    more = (f"algo={algo}", f"total_steps={9 * TINY_CALL}", "resume=true")
    (train if algo == "csac" else train_here)(tmp_path / "halves", *more, tiny=TINY_OFF_POLICY)
    full, halves = leaves(tmp_path / "full", 9), leaves(tmp_path / "halves", 9)
    assert full.keys() == halves.keys() and full["replay.rows"] == 72 and full["replay.cuts"].sum() > 0
    for name, leaf in full.items():
        np.testing.assert_array_equal(leaf, halves[name], err_msg=name)
    steps = checkpoint.list_steps(tmp_path / "full" / "checkpoints")
    assert [(path / "replay").exists() for path in steps] == [False, False, True]
    assert not (tmp_path / "full" / "checkpoints" / "best" / "replay").exists()


@pytest.mark.slow
@pytest.mark.parametrize("algo", [algo for algo in ON_POLICY if algo != "ppo"])
def test_policy_gradient_resume_is_exact(tmp_path, algo):
    settings = [
        f"algo={algo}",
        "iterations_per_call=1",
        "algo.ou_noise_std=0.1" if algo == "a2c" else "algo.discount=0.5",
    ]
    tiny = [setting for setting in TINY if "num_epochs" not in setting]
    train_here(tmp_path / "full", *settings, f"total_steps={4 * TINY_CALL}", tiny=tiny)
    half = (f"total_steps={2 * TINY_CALL}", f"algo.schedule_steps={4 * TINY_CALL}")
    train_here(tmp_path / "halves", *settings, *half, tiny=tiny)
    train_here(tmp_path / "halves", f"total_steps={4 * TINY_CALL}", "resume=true", tiny=[])
    full, halves = leaves(tmp_path / "full", 4), leaves(tmp_path / "halves", 4)
    assert full.keys() == halves.keys() and len(full) > 40 and ("exploration" in full) == (algo == "a2c")
    for name, leaf in full.items():
        np.testing.assert_array_equal(leaf, halves[name], err_msg=name)


@pytest.mark.slow
def test_a_replay_that_is_gone_is_filled_again(tmp_path):
    train_here(tmp_path / "run", "algo=sac", f"total_steps={6 * TINY_CALL}", tiny=TINY_OFF_POLICY)
    flip_a_byte(checkpoint.step_path(tmp_path / "run" / "checkpoints", 6 * TINY_CALL))
    before = leaves(tmp_path / "run", 4)
    done = train(tmp_path / "run", "algo=sac", f"total_steps={6 * TINY_CALL}", "resume=true", tiny=TINY_OFF_POLICY)
    assert "has no replay buffer; training refills it" in done.stderr
    after = leaves(tmp_path / "run", 6)
    assert after["replay.rows"] == 16 and after["iterations"] == 48
    # Two calls of eight iterations, the first seven of which wait for 64 transitions.
    assert after["critic_updates"] - before["critic_updates"] == 2 * (16 - 7)


def test_a_damaged_checkpoint_costs_only_its_own_calls(tmp_path, six_calls):
    shutil.copytree(six_calls("c"), tmp_path / "run")
    flip_a_byte(checkpoint.step_path(tmp_path / "run" / "checkpoints", 6 * TINY_CALL))
    with pytest.warns(UserWarning, match="damaged.*falling back"):
        train_here(tmp_path / "run", "resume=true", tiny=[])
    full, run = leaves(six_calls("c"), 6), leaves(tmp_path / "run", 6)
    for name, leaf in full.items():
        np.testing.assert_array_equal(leaf, run[name], err_msg=name)
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [row["env_steps"] for row in rows] == [i * TINY_CALL for i in range(1, 7)]


@pytest.mark.parametrize("name", slow_except(["SIGINT"], ["SIGINT", "SIGTERM", "SIGUSR1"]))
def test_signals_finish_the_call_save_and_say_how_to_continue(tmp_path, name):
    run_dir = tmp_path / "run"
    process = start("train", *TINY, f"run_dir={run_dir}", "total_steps=100000000")
    wait_for_rows(process, run_dir, 1)
    process.send_signal(getattr(signal, name))
    out = finish(process)
    assert process.returncode == 128 + getattr(signal, name).value
    assert f"To continue: python -m mjx_walk.train run_dir={run_dir} resume=true" in out and "Traceback" not in out
    last = json.loads((run_dir / "metrics.jsonl").read_text().splitlines()[-1])["env_steps"]
    newest = checkpoint.list_steps(run_dir / "checkpoints")[-1]
    assert int(newest.name) == last
    assert resolve([f"run_dir={run_dir}", "resume=true"]).env.name == "walker2d"


@pytest.mark.parametrize("link", ["eval_gymnasium.json", "checkpoints", "checkpoints/best/arrays", "films/x"])
def test_a_link_in_a_run_folder_is_refused_by_all_that_write(tmp_path, capsys, link):
    """Else a stranger's folder could make a command overwrite, or remove, what the link points to."""
    shutil.copytree(OLD_RUNS / "ppo", tmp_path / "run")
    outside, path = tmp_path / "outside", tmp_path / "run" / link
    outside.mkdir()
    (outside / "precious").write_text("mine")
    shutil.rmtree(path, ignore_errors=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(outside, target_is_directory=True)
    for command, *arguments in (
        *((name, f"run={tmp_path}/run") for name in ("eval", "play", "export", "plots")),
        ("train", f"run_dir={tmp_path}/run", "resume=true"),
    ):
        assert command_here(command, *arguments) == 2
        assert f"error: '{path}' is a symbolic link" in capsys.readouterr().err
    assert [(file.name, file.read_text()) for file in outside.iterdir()] == [("precious", "mine")]


def test_a_resume_that_fails_changes_nothing(two_calls):
    run_dir = two_calls
    path = checkpoint.step_path(run_dir / "checkpoints", 2 * TINY_CALL)
    shutil.copytree(path, f"{path}.copy")  # which is no checkpoint of the run
    flip_a_byte(path)
    before = (run_dir / "config.yaml").read_text()
    with pytest.warns(UserWarning, match="damaged"):
        assert command_here("train", f"run_dir={run_dir}", "resume=true", f"total_steps={9 * TINY_CALL}") == 2
    assert (run_dir / "config.yaml").read_text() == before


def test_a_run_that_was_scored_and_has_no_checkpoint_is_not_begun_again(two_calls, capsys):
    run_dir = two_calls
    shutil.rmtree(run_dir / "checkpoints")
    before = {path.name: path.read_bytes() for path in run_dir.iterdir() if path.is_file()}
    assert command_here("train", f"run_dir={run_dir}", "resume=true") == 2
    assert "no checkpoint in" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in run_dir.iterdir() if path.is_file()} == before


def test_a_run_that_saved_nothing_begins_again(two_calls):
    run_dir = two_calls
    (run_dir / "eval_gymnasium.json").unlink()
    full = leaves(run_dir, 2)
    shutil.rmtree(run_dir / "checkpoints")
    (run_dir / "checkpoints").mkdir()
    with pytest.warns(UserWarning, match="has no checkpoint; training restarts from step 0"):
        train_here(run_dir, "resume=true", tiny=[])
    again = leaves(run_dir, 2)
    for name, leaf in full.items():
        np.testing.assert_array_equal(leaf, again[name], err_msg=name)
    assert len((run_dir / "metrics.jsonl").read_text().splitlines()) == 2


@pytest.mark.slow
def test_a_longer_schedule_may_be_given_and_its_end_is_reported(tmp_path, capsys):
    run_dir, linear = tmp_path / "2026_11_23", ("algo.learning_rate_schedule=linear", "algo.schedule_steps=128")
    train_here(run_dir, f"total_steps={2 * TINY_CALL}", *linear)
    assert capsys.readouterr().err.count("warning") == 0
    params = "params.policy.params.hidden_0.kernel"
    for more, warns, learns in (((), True, False), (("algo.schedule_steps=1000",), False, True)):
        copy = tmp_path / f"copy_{learns}"
        shutil.copytree(run_dir, copy)
        train_here(copy, "resume=true", f"total_steps={4 * TINY_CALL}", *more, tiny=[])
        assert ("after algo.schedule_steps=128 the learning rate is zero" in capsys.readouterr().err) == warns
        assert np.array_equal(leaves(copy, 2)[params], leaves(copy, 4)[params]) != learns


def ctrl_c(*_):
    raise KeyboardInterrupt  # where tests run in the background, the signal itself is ignored


def sigterm(*_):
    signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize(("end", "code", "shown"), [(ctrl_c, 130, "Ctrl-C"), (sigterm, 143, "SIGTERM")])
@pytest.mark.slow
def test_a_signal_while_a_policy_is_scored_says_how_to_score_it(tmp_path, monkeypatch, capsys, end, code, shown):
    monkeypatch.setattr("mjx_walk.training.scoring.score_in_gymnasium", end)
    full = (*TINY, "evaluation.gymnasium_episodes=2", f"total_steps={TINY_CALL}", f"run_dir={tmp_path / 'run'}")
    assert command_here("train", *full) == code
    said = capsys.readouterr()
    assert f"python -m mjx_walk.eval run={tmp_path / 'run'}" in said.out and f"Stopped by {shown}." in said.err
    assert [int(path.name) for path in checkpoint.list_steps(tmp_path / "run" / "checkpoints")] == [TINY_CALL]
    monkeypatch.undo()
    assert command_here("eval", f"run={tmp_path / 'run'}", "episodes=2") == 0


def test_the_final_evaluation_ends_before_a_signal_takes_effect(tmp_path, monkeypatch, capsys):
    ended = []

    def evaluate(*arguments):
        sigterm()
        ended.append(True)
        return real(*arguments)

    real = scoring.evaluate
    monkeypatch.setattr(scoring, "evaluate", evaluate)
    assert command_here("train", *TINY, f"run_dir={tmp_path / 'run'}", f"total_steps={TINY_CALL}") == 143
    said = capsys.readouterr().err
    assert ended and said.endswith("SIGTERM: finishing the evaluation of the final policy\nStopped by SIGTERM.\n")
    assert (tmp_path / "run" / "checkpoints" / "final").exists()


def test_a_save_that_is_cut_short_has_kept_the_best_policy(tmp_path, monkeypatch, capsys):
    complete_save = checkpoint.save

    def save(path, *arguments, **options):
        if path.name.isdigit():
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        complete_save(path, *arguments, **options)

    monkeypatch.setattr(checkpoint, "save", save)
    assert command_here("train", *TINY, f"run_dir={tmp_path / 'run'}", f"total_steps={TINY_CALL}") == 2
    said = capsys.readouterr().err
    assert f"error: cannot write {tmp_path}/run/checkpoints/{TINY_CALL:013d}: No space left on device; " in said
    assert "Traceback" not in said
    monkeypatch.undo()
    assert command_here("eval", f"run={tmp_path / 'run'}", "episodes=1") == 0


def test_a_gymnasium_process_whose_parent_is_gone_ends_quietly():
    worker = start_module(
        "evaluation.gymnasium_worker", stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    pickle.dump(("Walker2d-v5", {}, [(0, ())], False), worker.stdin)
    worker.stdin.flush()
    assert pickle.load(worker.stdout)[0].shape == (1, 17)
    worker.stdout.close()
    pickle.dump(np.zeros((1, 6)), worker.stdin)
    worker.stdin.close()
    assert worker.stderr.read() == b"" and worker.wait() == 0
