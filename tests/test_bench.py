"""The benchmark runs, and its JSON says what was measured where."""

import contextlib
import json
import signal
import time

import jax
import jax.numpy as jnp
import pytest
from helpers import TINY_OFF_POLICY, command, command_here

from mjx_walk.bench import device_counts
from mjx_walk.experiments import scaling, timing
from mjx_walk.experiments.recorded_time import read_device_time
from mjx_walk.experiments.scaling import share_of_total
from mjx_walk.machine.subprocesses import start_module
from mjx_walk.settings.config import load_config
from mjx_walk.training.call_profile import CallProfile
from mjx_walk.utils.errors import UserError


@pytest.mark.slow
def test_bench_measures_and_writes(tmp_path):
    arguments = ("algo=td3", *TINY_OFF_POLICY, "num_envs=32", "seconds=0.5", f"out={tmp_path}/bench.json")
    done = command("bench", *arguments)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "bench.json").read_text())
    results = content["results"]
    assert results["training"] > 100
    assert all(results[f"compile and first call, {name} caches"] > 0 for name in ("cold", "warm"))
    assert content["env"] == "Walker2d-v5" and content["versions"]["mujoco"] and "32 environments" in content["device"]


SCALED = ["algo=td3", *TINY_OFF_POLICY, "num_envs=32", "iterations_per_call=1"]


def test_speeds_are_compared_with_one_device_s(monkeypatch):
    given = {("num_envs=32", 1): 100.0, ("num_envs=32", 2): 180.0, ("num_envs=16", 2): 120.0}

    def measure_speed(arguments, size, seconds):
        num_envs = [argument for argument in arguments if argument.startswith("num_envs=")][-1]
        return scaling.Speed(given[num_envs, size], 0.5)

    monkeypatch.setattr(scaling, "measure_speed", measure_speed)
    monkeypatch.setattr(scaling, "_parts", lambda *_: iter(()))
    results = {name: value for name, value, _ in scaling.measure(SCALED, load_config(SCALED), [1, 2], 0.5)}
    assert [results[f"training, {name} environments"] for name in ("1 x 32", "2 x 32", "2 x 16")] == [100, 180, 120]
    assert results["  2 x 32 environments: times one device"] == 1.8
    assert results["  2 x 16 environments: times one device"] == 1.2


@pytest.mark.slow
@pytest.mark.long
def test_what_a_device_does_in_a_call_is_recorded():
    """In a training in one process, and in one in two, of which the first one records."""
    shared = [*SCALED, *share_of_total(load_config(SCALED), 2)]
    parts = [*scaling._parts("1 x 32", SCALED, 1), *scaling._parts("2 x 16", shared, 2)]
    results = {name: value for name, value, _ in parts}
    assert results["  1 x 32: reductions in a recorded call"] == 0
    assert results["  2 x 16: reductions in a recorded call"] > 0
    assert results["  2 x 16: share of reductions"] > 0


def test_a_mistake_in_the_settings_costs_one_line(capsys):
    assert command_here("bench", "env=walker2d", "num_envs=3") == 2
    assert capsys.readouterr().err.startswith("error: num_envs=3 times algo.num_unrolls=1 must be a multiple of")


def test_devices_are_doubled_up_to_those_asked_for(capsys):
    assert [device_counts(asked) for asked in (None, 1, 4, 6)] == [[], [1], [1, 2, 4], [1, 2, 4, 6]]
    assert device_counts([4, 1]) == [1, 4]
    assert command_here("bench", "env=walker2d", "devices=0") == 2
    assert capsys.readouterr().err.startswith("error: devices=0 is not valid; use devices=all or an integer")


def test_a_speed_is_that_after_everything_is_compiled(monkeypatch):
    """Calls of 100 steps: 40 s of compiling, 5 s more for the programs that read results, then 2 s each."""
    rows = [{"env_steps": 100 * (i + 1), "wall_seconds": float(at)} for i, at in enumerate([40, 47, 49, 51, 53, 55])]

    @contextlib.contextmanager
    def logged(arguments, are_enough, _):
        assert "devices=2" in arguments
        yield next(rows[:count] for count in range(1, 7) if are_enough(rows[:count])), None

    monkeypatch.setattr(scaling, "training", logged)
    for seconds in (1, 8):
        speed = scaling.measure_speed(["env=humanoid"], 2, seconds)
        assert speed == (50.0, 2.0)


@pytest.mark.slow
def test_a_training_that_hangs_is_ended(monkeypatch):
    """After its first row the training stands still and ignores SIGTERM, as one that blocks within CUDA does."""
    stopped = []

    def start_and_stop(*arguments, **options):
        process = start_module(*arguments, **options)
        stopped.append(process)
        return process

    def stop_at_the_first_row(rows):
        if rows:
            stopped[0].send_signal(signal.SIGSTOP)
        return False

    monkeypatch.setattr(timing, "start_module", start_and_stop)
    monkeypatch.setattr(timing, "_PATIENCE", 2.0)
    settings = ["algo=td3", *TINY_OFF_POLICY, "total_steps=1000000"]
    with (
        pytest.raises(RuntimeError, match=r"steps(.|\n)*no row for [0-9]+ s"),
        timing.training(settings, stop_at_the_first_row, signal.SIGTERM),
    ):
        pass
    assert stopped[0].returncode == -signal.SIGKILL


def test_several_devices_share_what_one_has():
    config = load_config(["algo=td3", "num_envs=32", "algo.batch_size=64", "algo.replay_capacity=1000"])
    assert share_of_total(config, 4) == ["num_envs=8", "algo.batch_size=16", "algo.replay_capacity=250"]
    assert share_of_total(load_config(["algo=ppo", "num_envs=64", "algo.num_minibatches=2"]), 2) == ["num_envs=32"]
    with pytest.raises(UserError, match="num_envs=32 cannot be divided evenly among 3 devices"):
        share_of_total(config, 3)


def test_calls_are_recorded_from_the_third_one_on(tmp_path):
    """`read_device_time` sums the operations of one call of a program with a loop, which takes that long again."""
    advance = jax.jit(lambda x: jax.lax.fori_loop(0, 20, lambda _, x: jnp.tanh(x @ x), x))
    for num_calls, folder in ((0, tmp_path / "none"), (1, tmp_path / "one")):
        with CallProfile(folder, num_calls) as profile:
            x, times = jnp.eye(400), []
            for _ in range(4):
                profile.next_call()
                start = time.monotonic()
                x = jax.block_until_ready(advance(x))
                times.append(time.monotonic() - start)
    with pytest.raises(FileNotFoundError, match="no recording"):
        read_device_time(tmp_path / "none")
    recorded = read_device_time(tmp_path / "one")
    assert 0 < recorded.total <= times[2] and recorded.reductions == recorded.physics == 0
