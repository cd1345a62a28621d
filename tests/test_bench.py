"""The benchmark runs, and its JSON says what was measured where."""

import json

import pytest
from commands import command


@pytest.mark.parametrize("algo", ["ppo", "td3"])
def test_bench_measures_and_writes(tmp_path, algo):
    arguments = ("env=walker2d", f"algo={algo}", "num_envs=16", "seconds=0.5", f"out={tmp_path}/bench.json")
    done = command("bench", *arguments)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "bench.json").read_text())
    results = content["results"]
    speeds = ("Gymnasium, one core", "physics only", "physics, observation and reward", "training")
    assert all(results[name] > 100 for name in speeds)
    inserts = [value for name, value in results.items() if name.startswith("insert of 4,096 transitions")]
    assert len(inserts) == (2 if algo == "td3" else 0) and all(value > 0 for value in inserts)
    assert results["compile and first update, cold cache"] > 0 and results["peak memory, host"] > 0.1
    assert content["env"] == "Walker2d-v5" and content["versions"]["mujoco"] and "16 copies" in content["device"]
