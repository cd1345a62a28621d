"""The benchmark runs, and its JSON says what was measured where."""

import json

import jax
import jax.numpy as jnp
import pytest
from helpers import TINY_OFF_POLICY, command, command_here

from mjx_walk.bench import device_counts
from mjx_walk.experiments import timing
from mjx_walk.experiments.profile import matmul_flops


@pytest.mark.slow
def test_bench_measures_and_writes(tmp_path):
    arguments = ("algo=td3", *TINY_OFF_POLICY, "num_envs=32", "seconds=0.5", f"out={tmp_path}/bench.json")
    done = command("bench", *arguments, "devices=2")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "bench.json").read_text())
    results = content["results"]
    speeds = ("Gymnasium, one core", "physics only", "physics, observation and reward", "training")
    assert all(results[name] > 100 for name in speeds)
    for part, limit in (("collecting", "physics alone"), ("learning", "matrix products alone")):
        assert results[f"an iteration: {part}"] > 0 and results[f"  of which {limit} would take"] > 0
    inserts = [value for name, value in results.items() if name.startswith("insert of 4,096 transitions")]
    assert len(inserts) == 2 and all(value > 0 for value in inserts)
    assert all(results[f"compile and first call, {name} caches"] > 0 for name in ("cold", "warm"))
    on = [results[name] for name in results if name.startswith("training on ")]
    assert len(on) == 2 and all(speed > 10 for speed in on)
    assert results["  speedup over 1 device, of 2"] == on[1] / on[0]
    assert results["peak memory, host"] > 0.1
    assert content["env"] == "Walker2d-v5" and content["versions"]["mujoco"] and "32 environments" in content["device"]


def test_a_mistake_in_the_settings_costs_one_line(capsys):
    assert command_here("bench", "env=walker2d", "num_envs=3") == 2
    assert capsys.readouterr().err.startswith("error: num_envs=3 times algo.num_unrolls=1 must be a multiple of")


def test_devices_are_doubled_up_to_those_asked_for(capsys):
    assert [device_counts(asked) for asked in (None, 1, 4, 6)] == [[], [1], [1, 2, 4], [1, 2, 4, 6]]
    assert command_here("bench", "env=walker2d", "devices=0") == 2
    assert capsys.readouterr().err.startswith("error: devices=0 is not valid; use devices=all or an integer")


def test_a_speed_is_that_after_everything_is_compiled(monkeypatch):
    """Calls of 100 steps: 40 s of compiling, 5 s more for the programs that read results, then 2 s each."""
    rows = [{"env_steps": 100 * (i + 1), "wall_seconds": float(at)} for i, at in enumerate([40, 47, 49, 51, 53, 55])]

    def logged(arguments, are_enough, *_):
        assert "devices=2" in arguments
        return next(rows[:count] for count in range(1, 7) if are_enough(rows[:count]))

    monkeypatch.setattr(timing, "_rows_of", logged)
    assert timing.speeds_by_devices(["env=humanoid"], [2], seconds=1) == {2: 50.0}
    assert timing.speeds_by_devices(["env=humanoid"], [2], seconds=8) == {2: 50.0}


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
