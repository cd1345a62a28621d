"""The programs of `benchmarks` run, and count what they report."""

import importlib.util
import json
import re
import runpy
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import CLONE, PAGES, TINY_OFF_POLICY, command_here
from program_costs import matmul_flops, reduced_bytes

from mjx_walk.utils import collectives


def exit_code(name, *arguments):
    """Exit code of `python benchmarks/NAME ARGUMENTS`, run in this process."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "argv", [name, *arguments])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(CLONE / "benchmarks" / name), run_name="__main__")
    return ended.value.code


def test_programs_that_the_documentation_names_are_there(capsys):
    named = {name for text in PAGES.values() for name in re.findall(r"python benchmarks/(\S+\.py)", text)}
    assert named == {path.name for path in (CLONE / "benchmarks").glob("*.py")} - {
        "peer_returns.py",
        "program_costs.py",
    }
    for name, package in (("sbx_training.py", "sbx"), ("cleanrl_training.py", "envpool")):
        if importlib.util.find_spec(package) is None:
            named.remove(name)
    for name in named:
        assert exit_code(name, "--help") == 0
        assert capsys.readouterr().out.startswith(f"usage: python benchmarks/{name} ")


def test_policies_are_scored_on_hills(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["hills.py", "zoo:hopper-ppo", "--episodes", "2"])
    runpy.run_path(str(CLONE / "benchmarks" / "hills.py"), run_name="__main__")
    header, row = capsys.readouterr().out.splitlines()
    assert header == "Run,slopes,steps,rough,mixed"
    assert row.startswith("zoo:hopper-ppo,") and all(100 < float(mean) < 3000 for mean in row.split(",")[1:])


@pytest.mark.slow
def test_a_training_of_sbx_continues_and_is_scored(tmp_path, monkeypatch):
    """The first call ends after its first step."""
    pytest.importorskip("sbx", reason="pip install sbx-rl")
    settings = ("--env", "inverted_pendulum", "--every", "20", "--episodes", "5", "--out", str(tmp_path))
    for total, seconds in (("60", "0"), ("60", "1000")):
        monkeypatch.setattr(sys, "argv", ["sbx_training.py", *settings, "--total-steps", total, "--seconds", seconds])
        runpy.run_path(str(CLONE / "benchmarks" / "sbx_training.py"), run_name="__main__")
    monkeypatch.setattr(sys, "argv", ["sbx_training.py", *settings, "--seed", "1"])
    with pytest.raises(SystemExit, match="training is tqc on InvertedPendulum-v5, seed 0, not tqc on"):
        runpy.run_path(str(CLONE / "benchmarks" / "sbx_training.py"), run_name="__main__")
    header, *rows = (line.split(",") for line in (tmp_path / "returns.csv").read_text().splitlines())
    assert header == ["steps", "seconds", "episodes", "mean", "std"]
    assert [row[0] for row in rows] == ["1", "20", "40", "60"] and [row[2] for row in rows] == ["1", "1", "1", "5"]
    seconds = [float(row[1]) for row in rows]
    assert seconds == sorted(seconds) and all(1 <= float(row[3]) <= 1000 for row in rows)


CLEANRL_LIKE = """
import sys
import gymnasium as gym
import torch

settings = dict(argument.removeprefix("--").split("=") for argument in sys.argv[1:])
envs = gym.vector.SyncVectorEnv([lambda: gym.make(settings["env-id"])])
agent = torch.nn.Module()
agent.actor_mean = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
obs, _ = envs.reset(seed=int(settings["seed"]))
for _ in range(int(settings["total-timesteps"]) // len(obs)):
    with torch.no_grad():
        obs = torch.Tensor(envs.step(agent.actor_mean(torch.Tensor(obs)).numpy())[0])
    assert obs.abs().max() <= 10
"""
"""The names that CleanRL's file has, which is in no package registry."""


@pytest.mark.slow
def test_policies_of_cleanrl_are_kept_on_the_way_and_scored(tmp_path, monkeypatch):
    pytest.importorskip("envpool")
    script = tmp_path / "ppo_continuous_action.py"
    script.write_text(CLEANRL_LIKE)
    settings = ("--env", "inverted_pendulum", "--total-steps", "100", "--num-envs", "4", "--every", "40")
    out = ("--episodes", "10", "--out", str(tmp_path / "out"))
    monkeypatch.setattr(sys, "argv", ["cleanrl_training.py", str(script), *settings, *out])
    runpy.run_path(str(CLONE / "benchmarks" / "cleanrl_training.py"), run_name="__main__")
    header, *rows = (line.split(",") for line in (tmp_path / "out" / "returns.csv").read_text().splitlines())
    assert header == ["steps", "seconds", "episodes", "mean", "std"]
    assert [row[0] for row in rows] == ["40", "80", "100"] and [row[2] for row in rows] == ["2", "2", "10"]
    assert all(1 <= float(row[3]) <= 1000 for row in rows)


@pytest.mark.slow
def test_a_kept_policy_of_cleanrl_acts_as_the_agent_did(monkeypatch):
    pytest.importorskip("envpool")
    torch, training = (importlib.import_module(name) for name in ("torch", "cleanrl_training"))
    pool = training.Pool("InvertedPendulum-v5", 4, 0, 1000, 1000.0)
    env = training.make_vector_env(pool)
    env.reset()
    agent = torch.nn.Module()
    agent.actor_mean = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
    for _ in range(20):
        normalized, *_ = env.step(np.ones((4, 1)))
    pool.keep(agent)
    statistics = pool.observation_statistics
    obs = normalized * np.sqrt(statistics.var + 1e-8) + statistics.mean
    with torch.no_grad():
        expected = agent.actor_mean(torch.Tensor(normalized)).numpy().clip(-3, 3)
        agent.actor_mean[0].weight += 1
    np.testing.assert_allclose(pool.kept[0].act(obs), expected, atol=1e-5)
    hurried = training.Pool("InvertedPendulum-v5", 4, 0, 1000, 0.0)
    training.make_vector_env(hurried).reset()
    monkeypatch.setattr(sys.modules["__main__"], "agent", agent, raising=False)
    with pytest.raises(training.TimeIsOver):
        hurried.step(np.ones((4, 1)))
    assert [kept.steps for kept in hurried.kept] == [4]


@pytest.mark.slow
def test_environments_for_other_trainers_are_measured(monkeypatch, capsys):
    pytest.importorskip("stable_baselines3")
    arguments = ["--env", "inverted_pendulum", "--num-envs", "8", "--seconds", "0.1", "--rounds", "2"]
    monkeypatch.setattr(sys, "argv", ["adapters.py", *arguments])
    runpy.run_path(str(CLONE / "benchmarks" / "adapters.py"), run_name="__main__")
    header, *rows = (line.split(",") for line in capsys.readouterr().out.splitlines())
    assert header == ["Environment", "Steps/s", "Ratio"] and rows[0][0] == "training's environment"
    assert {"PyTorch", "Stable-Baselines3"} <= {row[0] for row in rows}
    assert rows[0][2] == "1.000" and all(int(row[1]) > 0 and float(row[2]) > 0 for row in rows)


def test_exported_policies_are_scored_without_this_package(tmp_path):
    assert command_here("export", "run=zoo:inverted_pendulum-csac", f"out={tmp_path}/pendulum.onnx") == 0
    code = (CLONE / "benchmarks" / "mujoco_versions.py").read_text()
    code += '\n    assert not {"jax", "mjx_walk"} & set(sys.modules)\n'
    (tmp_path / "score.py").write_text(code)
    line = [sys.executable, "score.py", "pendulum.onnx", "--episodes", "2"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True)
    header, row = done.stdout.splitlines()
    assert header == "Policy,MuJoCo,Episodes,Mean,Std" and row == f"pendulum,{mujoco.__version__},2,1000.00,0.00"


@pytest.mark.slow
def test_the_parts_of_training_are_measured_and_written(tmp_path):
    arguments = ("algo=td3", *TINY_OFF_POLICY, "num_envs=32", "seconds=0.5", f"out={tmp_path}/parts.json")
    assert exit_code("training_parts.py", *arguments) == 0
    content = json.loads((tmp_path / "parts.json").read_text())
    results = content["results"]
    speeds = ("Gymnasium, one core", "physics only", "physics, observation and reward", "training")
    assert all(results[name] > 100 for name in speeds)
    for part, limit in (("collecting", "physics alone"), ("learning", "matrix products alone")):
        assert results[f"an iteration: {part}"] > 0 and results[f"  of which {limit} would take"] > 0
    inserts = [value for name, value in results.items() if name.startswith("insert of 4,096 transitions")]
    assert len(inserts) == 2 and all(value > 0 for value in inserts)
    assert results["peak memory, host"] > 0.1 and results["data to reduce in an iteration, per device"] > 0
    assert content["env"] == "Walker2d-v5" and content["versions"]["mujoco"] and "32 environments" in content["device"]


@pytest.mark.parametrize(
    ("name", "argument", "message"),
    [
        ("peers.py", "algo=td3", "Brax has no td3 to compare with; choose algo=ppo or algo=sac"),
        ("training_parts.py", "second=3", "unknown key 'second'; did you mean: seconds, seed?"),
    ],
)
def test_a_mistake_costs_one_line(name, argument, message, capsys):
    assert exit_code(name, argument) == 2
    assert capsys.readouterr().err == f"error: {message}\n"


def test_reduced_data_are_counted():
    """The gradient of one layer, in each of two updates; a mean of one number."""

    class OneLayer:
        def state_shapes(self):
            return jax.ShapeDtypeStruct((3, 5), jnp.float32)

        def collect(self, state):
            return state, jnp.zeros((7, 3))

        def learn(self, state, batch):
            def update(weights, _):
                grads = jax.grad(lambda weights: jnp.square(batch @ weights).mean())(weights)
                return weights - collectives.mean(grads, collectives.DEVICES), None

            state, _ = jax.lax.scan(update, state, length=2)
            return state, collectives.total(state.sum(), collectives.DEVICES)

    assert reduced_bytes(OneLayer(), 4) == 4 * (2 * 3 * 5 + 1)


def test_products_are_counted():
    """By hand: 2·m·k·n each; ten times in a loop; the larger of two branches; twice in the gradient of a vector."""
    a, b, v = jnp.zeros((3, 5)), jnp.zeros((5, 7)), jnp.zeros(5)
    assert matmul_flops(lambda a, b: a @ b, a, b) == 2 * 3 * 5 * 7
    assert matmul_flops(jax.vmap(lambda v, b: v @ b, (0, None)), a, b) == 2 * 3 * 5 * 7
    loop = jax.jit(lambda a: jax.lax.scan(lambda c, _: (c + a @ b @ b.T, None), a, length=10)[0])
    assert matmul_flops(loop, a) == 10 * 2 * (2 * 3 * 5 * 7)
    branch = lambda c: jax.lax.cond(c, lambda: (a @ b)[0, 0], lambda: 0.0)  # noqa: E731
    assert matmul_flops(branch, True) == 2 * 3 * 5 * 7
    assert matmul_flops(jax.grad(lambda b: jnp.tanh(v @ b).sum()), b) == 2 * (2 * 5 * 7)
