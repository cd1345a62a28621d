"""First half of the GPU gate: every algorithm, several seeds and GPUs, interruptions, comparisons and speeds."""

import csv
import json
import signal
import time

import pytest
from gpu_gate import checked_rows, finish, run, run_python, start
from helpers import CLONE, wait_for_line

from mjx_walk.settings.config import load_config
from mjx_walk.storage import checkpoint

pytestmark = pytest.mark.gpu

ALGORITHMS = {
    "ppo": "humanoid",
    "csac": "humanoid",
    "sac": "walker2d",
    "td3": "humanoid_standup",
    "ddpg": "walker2d",
    "a2c": "humanoid",
    "reinforce": "walker2d",
}
"""Each algorithm with one of the three tasks."""
SMALL = ("env=walker2d", "algo=ppo", "num_envs=1024", "iterations_per_call=2", "evaluation.gymnasium_episodes=0")


def steps_of_calls(num_calls: int, *overrides: str) -> int:
    """Environment steps of that many calls of a recipe for a GPU. Nothing here starts JAX in the tests' process."""
    config = load_config([*overrides, "hardware=gpu"])
    num_unrolls = vars(config.algo).get("num_unrolls", 1)
    return num_calls * config.iterations_per_call * config.num_envs * config.algo.unroll_length * num_unrolls


def train(run_dir, num_calls: int, *overrides: str, count: int = 1) -> str:
    """Train that many calls."""
    return run(
        "train", *overrides, f"run_dir={run_dir}", f"total_steps={steps_of_calls(num_calls, *overrides)}", count=count
    )


def speed(rows) -> str:
    """Environment steps per second after the first call."""
    first, last = rows[0], rows[-1]
    steps = last["env_steps"] - first["env_steps"]
    return f"{steps / (last['wall_seconds'] - first['wall_seconds']):,.0f} steps/s"


def test_bench_of_two_gpus(record_property):
    """The two speeds; `test_bench` waits for the end of a bench."""
    process = start("bench", "env=inverted_pendulum", "num_envs=2048", "seconds=1", "devices=[2]", count=2)
    lines = []
    for size in (2048, 1024):
        lines.append(wait_for_line(process, f"training, 2 x {size} environments"))
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate()
    assert process.returncode == 128 + signal.SIGTERM, output
    record_property("measured", "; ".join(" ".join(line.split()) for line in lines))


def test_bench(record_property):
    printed = run("bench", "env=walker2d", "algo=ppo", "seconds=1")
    (line,) = [line for line in printed.splitlines() if "steps/s" in line]
    record_property("measured", " ".join(line.split()))


def test_parts_of_training(record_property):
    program = (CLONE / "benchmarks" / "training_parts.py").read_text()
    printed = run_python(program, "env=walker2d", "algo=ppo", "seconds=1", cwd=CLONE / "benchmarks")
    lines = [line for line in printed.splitlines() if "steps/s" in line]
    assert len(lines) >= 3
    record_property("measured", "; ".join(" ".join(line.split()) for line in lines))


@pytest.mark.parametrize("algo", ["ppo", "csac"])
def test_two_gpus_then_one(algo, tmp_path, record_property):
    settings = ("env=humanoid", f"algo={algo}", "evaluation.gymnasium_episodes=0", "checkpoint.every_calls=1")
    run_dir, steps = tmp_path / "run", steps_of_calls(1, *settings)
    printed = run("train", *settings, f"run_dir={run_dir}", "devices=2", f"total_steps={8 * steps}", count=2)
    assert "2 × NVIDIA" in printed
    together = speed(checked_rows(run_dir, 4))
    run("train", f"run_dir={run_dir}", "resume=true", "devices=1", f"total_steps={10 * steps}")
    rows = checked_rows(run_dir, 6)
    assert [row["env_steps"] for row in rows] == [2 * steps, 4 * steps, 6 * steps, 8 * steps, 9 * steps, 10 * steps]
    record_property("measured", f"two GPUs: {together}")


@pytest.mark.parametrize(("algo", "env"), ALGORITHMS.items())
def test_algorithm(algo, env, tmp_path, record_property):
    printed = train(tmp_path / "run", 4, f"env={env}", f"algo={algo}", "evaluation.gymnasium_episodes=2")
    assert "physics=warp" in printed and "Final policy (step " in printed
    rows = checked_rows(tmp_path / "run", 4)
    assert any("loss" in name for name in rows[-1])
    scores = json.loads((tmp_path / "run" / "eval_gymnasium.json").read_text())
    assert len(scores["final"]["returns"]) == 2
    record_property("measured", f"{env}, {speed(rows)}")


def test_two_seeds_in_one_process(tmp_path):
    steps = steps_of_calls(3, *SMALL)
    run("train", *SMALL, "seeds=2", f"run_dir={tmp_path}/seeds", f"total_steps={steps}")
    first, second = (checked_rows(tmp_path / "seeds" / f"seed_{seed}", 3) for seed in (0, 1))
    assert [row["env_steps"] for row in first] == [row["env_steps"] for row in second]
    assert first[-1]["episode/return"] != second[-1]["episode/return"]


def test_kill_and_resume(tmp_path):
    run_dir, steps = tmp_path / "run", steps_of_calls(1, *SMALL)
    settings = (*SMALL, f"run_dir={run_dir}", "checkpoint.every_calls=1")
    process = start("train", *settings, f"total_steps={60 * steps}")
    metrics = run_dir / "metrics.jsonl"
    deadline = time.monotonic() + 300
    while not metrics.exists() or metrics.read_text().count("\n") < 4:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()[0]
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert 0 < int(checkpoint.list_steps(run_dir / "checkpoints")[-1].name) < 60 * steps
    run("train", f"run_dir={run_dir}", "resume=true")
    assert [row["env_steps"] for row in checked_rows(run_dir, 60)] == [call * steps for call in range(1, 61)]


def test_two_trainings_share_a_gpu(tmp_path):
    steps = steps_of_calls(4, *SMALL)
    settings = [(*SMALL, f"seed={seed}", f"run_dir={tmp_path}/{seed}", f"total_steps={steps}") for seed in (0, 1)]
    for process in [start("train", *arguments) for arguments in settings]:
        finish(process)
    for seed in (0, 1):
        checked_rows(tmp_path / str(seed), 4)


def test_compare(tmp_path):
    settings = ("env=inverted_pendulum", "num_envs=512", "iterations_per_call=2", "total_steps=200_000")
    out = tmp_path / "out"
    run("compare", *settings, "algos=[ppo,a2c]", "seeds=2", "per_device=2", "together=1", f"out={out}")
    with (out / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["variant"] for row in rows} == {"ppo", "a2c"} and (out / "comparison.png").stat().st_size > 10_000
    assert len(list(out.rglob("eval_gymnasium.json"))) == 4
