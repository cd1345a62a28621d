"""A run from end to end: what is in its folder, and what its numbers mean."""

import json
import math
import os
import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from helpers import TINY, TINY_CALL, command_here
from shared_programs import shared_programs
from tensorboardX.proto.event_pb2 import Event

import mjx_walk
from mjx_walk import train as train_command
from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import make_env
from mjx_walk.training import trainer
from mjx_walk.utils import setting_fields
from mjx_walk.utils.errors import UserError


@pytest.fixture(autouse=True)
def _programs_are_shared():
    with shared_programs():
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small run through the Python interface, with the rows it reported."""
    rows = []
    path = tmp_path_factory.mktemp("runs") / "run"
    overrides = [*TINY, f"run_dir={path}", f"total_steps={60 * TINY_CALL}", "env.max_episode_steps=40"]
    run = mjx_walk.run([*overrides, "evaluation.gymnasium_episodes=3"], on_metrics=rows.append)
    return run, rows


def test_the_folder_holds_what_it_should(finished):
    run, _ = finished
    names = {path.name for path in run.path.iterdir()}
    assert {"config.yaml", "metrics.jsonl", "checkpoints", "eval_gymnasium.json"} <= names
    for name in ("learning_curve.png", "reward_terms.png", "losses.png"):
        assert (run.path / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        assert (run.path / name).stat().st_size > 10_000
    steps = sorted(path.name for path in (run.path / "checkpoints").iterdir())
    assert steps == [f"{call * TINY_CALL:013d}" for call in (56, 58, 60)] + ["best", "final"]


def test_metrics_name_everything(finished):
    run, rows = finished
    assert run.metrics == json.loads(json.dumps(rows))
    assert [row["env_steps"] for row in rows] == [TINY_CALL * (i + 1) for i in range(60)]
    needed = {
        "episode/return", "episode/length", "episode/reward_forward", "episode/reward_ctrl", "episode/reward_survive",
        "train/loss", "train/policy_loss", "train/value_loss", "train/kl", "train/entropy", "train/learning_rate",
        "speed/steps_per_second", "physics/nonfinite", "physics/overflow", "resets/reuse_rate", "eval/return",
        "eval/length", "wall_seconds",
    }  # fmt: skip
    assert needed <= {name for row in rows for name in row}
    for row in rows:
        if row["episode/count"]:
            terms = row["episode/reward_forward"] + row["episode/reward_ctrl"] + row["episode/reward_survive"]
            assert terms == pytest.approx(row["episode/return"], rel=1e-4, abs=1e-3)
    evaluated = [row for row in rows if "eval/return" in row]
    assert len(evaluated) > 5 and all(row["eval/env_steps"] < row["env_steps"] for row in evaluated)


def test_tensorboard_holds_the_same(finished):
    run, rows = finished
    data = next(run.path.glob("events.*")).read_bytes()
    values, at = {}, 0
    while at < len(data):  # TFRecord: length, its checksum, the event, its checksum
        size = int.from_bytes(data[at : at + 8], "little")
        event = Event.FromString(data[at + 12 : at + 12 + size])
        values |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
        at += size + 16
    for row in rows[1 :: len(rows) // 5]:
        for name in ("train/loss", "speed/steps_per_second"):
            assert values[name, row["env_steps"]] == pytest.approx(row[name], rel=1e-5)


@pytest.mark.parametrize("name", ["final", "best"])
def test_gymnasium_scores_are_those_of_a_plain_loop(finished, name):
    """The file's episodes, played again by the reader's own ten lines."""
    run, _ = finished
    content = json.loads((run.path / "eval_gymnasium.json").read_text())
    assert content["env"] == "Walker2d-v5" and "mujoco" in content["versions"]
    block, policy = content[name], mjx_walk.load_run(run.path, policy=name)
    assert block["seeds"] == [0, 1, 2] and block["env_steps"] == policy.policy_metadata["env_steps"]
    for seed, expected, length in zip(block["seeds"], block["returns"], block["lengths"], strict=True):
        env = gymnasium.make("Walker2d-v5", max_episode_steps=40)
        obs, _ = env.reset(seed=seed)
        total, steps, done = 0.0, 0, False
        while not done:
            action = policy.policy(np.stack([obs] * 3))[0]  # as many as scored at once: one alone may round differently
            obs, reward, terminated, truncated, _ = env.step(action)
            total, steps, done = total + reward, steps + 1, terminated or truncated
        assert (total, steps) == (pytest.approx(expected, rel=1e-6), length)
    assert block["mean"] == pytest.approx(np.mean(block["returns"]))
    assert block["std"] == pytest.approx(np.std(block["returns"], ddof=1))


def test_a_loaded_policy_scores_alike_in_its_engine_and_in_gymnasium(finished):
    run, _ = finished
    loaded = mjx_walk.load_run(run.path)
    sim, real = loaded.evaluate(64, backend="sim"), loaded.evaluate(64, backend="gymnasium")
    error = math.hypot(sim.std, real.std) / 8
    assert abs(sim.mean - real.mean) < max(4 * error, 0.02 * abs(real.mean))


def test_scores_in_the_engine_compile_once(finished, monkeypatch):
    run, _ = finished
    loaded, traces = mjx_walk.load_run(run.path), []
    step = loaded.task.step
    monkeypatch.setattr(loaded.task, "step", lambda *args: traces.append(1) or step(*args))
    first = loaded.evaluate(2, backend="sim")
    assert traces
    traces.clear()
    other, again = loaded.evaluate(2, backend="sim", seed=1), loaded.evaluate(2, backend="sim")
    assert not traces
    assert again.returns.tolist() == first.returns.tolist() != other.returns.tolist()


def test_many_episodes_are_played_in_rounds(finished, monkeypatch):
    run, _ = finished
    at_once = run.evaluate(5, seed=3)
    monkeypatch.setattr("mjx_walk.evaluation.gymnasium_scores.MAX_PARALLEL_EPISODES", 2)
    in_rounds = run.evaluate(5, seed=3)
    assert in_rounds.seeds == at_once.seeds == [3, 4, 5, 6, 7]
    assert in_rounds.returns == pytest.approx(at_once.returns, rel=1e-6)
    assert in_rounds.lengths.tolist() == at_once.lengths.tolist()


def test_eval_command(finished, capsys):
    run, _ = finished
    assert command_here("eval", f"run={run.path}", "episodes=2", "backend=sim") == 0
    score, choice = capsys.readouterr().out.splitlines()
    assert score.startswith("Final policy") and "Walker2d-v5 on c" in score
    assert "export and load_run take the best one: policy=best" in choice
    file = run.path / "eval_gymnasium.json"
    before = json.loads(file.read_text())
    for name in ("final", "best"):
        assert command_here("eval", f"run={run.path}", f"policy={name}", "episodes=2", "seed=7") == 0
        (line,) = capsys.readouterr().out.splitlines()
        assert line.startswith(f"{name.title()} policy (step {before[name]['env_steps']:,}), Walker2d")
    after = json.loads(file.read_text())
    assert after["final"]["seeds"] == after["best"]["seeds"] == [7, 8]
    file.write_text(json.dumps(before))


def test_export_says_which_policy_it_takes(finished, tmp_path, capsys):
    run, _ = finished
    steps = {name: mjx_walk.load_run(run.path, policy=name).policy_metadata["env_steps"] for name in ("final", "best")}
    choice = "The best policy has the highest evaluation during training. eval scores the final one: policy=final"
    for arguments, name, said in (([], "best", [choice]), (["policy=final"], "final", [])):
        assert command_here("export", f"run={run.path}", f"out={tmp_path}/policy.onnx", *arguments) == 0
        lines = capsys.readouterr().out.splitlines()[1:]
        assert lines == [f"It holds the {name} policy (step {steps[name]:,}).", *said]


@pytest.mark.slow
def test_a_sweep_puts_each_job_in_its_own_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [*TINY, f"total_steps={TINY_CALL}"]
    assert command_here("train", "-m", "seed=0,1", *arguments) == 0
    assert len(list(tmp_path.glob("runs/sweeps/*/*/metrics.jsonl"))) == 2
    # One job of a sweep that fails does not end the others.
    assert command_here("train", "-m", "num_envs=7,8", *arguments[:1], *arguments[2:]) == 2
    printed = capsys.readouterr().err
    assert "choose num_envs a multiple of 2" in printed and "Traceback" not in printed
    assert len(list(tmp_path.glob("runs/sweeps/*/*/metrics.jsonl"))) == 3


def test_a_signal_ends_a_sweep(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trainer.Trainer, "_stop_signal", lambda self, interrupt: "SIGTERM")
    assert command_here("train", "-m", "seed=0,1", *TINY, f"total_steps={TINY_CALL}") == 143
    assert len(list(tmp_path.glob("runs/sweeps/*/*/config.yaml"))) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "Stopped by SIGTERM."


def test_a_model_is_found_from_another_folder_and_a_number_is_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [*TINY, f"total_steps={TINY_CALL}", "env.xml_file=mine.xml", "run_dir=2026_11_23"]
    theirs = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "walker2d.xml"
    (tmp_path / "mine.xml").write_text(theirs.read_text())
    assert command_here("train", *arguments) == 0
    monkeypatch.chdir("/")
    assert command_here("eval", f"run={tmp_path / '2026_11_23'}", "episodes=1") == 0
    assert "Walker2d-v5: " in capsys.readouterr().out


def test_an_asset_of_gymnasium_s_is_a_model():
    task = make_env("walker2d", physics="c", xml_file="walker2d.xml")
    env = gymnasium.make(task.gymnasium_id, **task.gymnasium_kwargs())
    assert env.unwrapped.fullpath.endswith("assets/walker2d.xml")
    np.testing.assert_array_equal(env.unwrapped.model.geom_size, task.model.geom_size)


def test_configuration_can_be_printed(capsys):
    assert train_command.main(["--help"]) == 0
    assert "usage: python -m mjx_walk.train" in capsys.readouterr().out


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_help_says_what_the_settings_of_an_algorithm_mean(algo, capsys):
    assert train_command.main(["--help", f"algo={algo}"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    schema = ALGORITHMS[algo][1]
    for row in setting_fields.table(schema):
        assert f"algo.{row.name}=" in shown and setting_fields.meanings(schema)[row.name] in shown


@pytest.mark.parametrize("arguments", [["env=walker2d", "--cfg", "job"], ["algo=sac", "--cfg", "job", "env=walker2d"]])
def test_flags_may_stand_anywhere(arguments, capsys):
    assert command_here("train", *arguments) == 0
    assert "name: walker2d" in capsys.readouterr().out


def test_a_run_keeps_its_folder_when_the_working_directory_changes(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished[0].path, "copy")
    run = mjx_walk.load_run("copy")
    monkeypatch.chdir("/")
    assert run.path == tmp_path / "copy" and run.metrics == finished[0].metrics
    (tmp_path / "copy" / "metrics.jsonl").unlink()
    with pytest.raises(UserError, match=f"{tmp_path}/copy/metrics.jsonl is missing"):
        _ = mjx_walk.load_run(tmp_path / "copy").metrics
    assert mjx_walk.load_run("zoo:hopper-ppo").metrics == []


def test_a_training_keeps_its_folder_when_a_callback_changes_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    arguments = [*TINY, "run_dir=run", f"total_steps={2 * TINY_CALL}"]
    run = mjx_walk.run(arguments, on_metrics=lambda row: os.chdir(tmp_path / "elsewhere"))
    assert run.path == tmp_path / "run" and len(run.metrics) == 2
    assert not list((tmp_path / "elsewhere").iterdir())
