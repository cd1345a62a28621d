"""The benchmark runs, and its JSON says what was measured where."""

import json

from commands import command


def test_bench_measures_and_writes(tmp_path):
    done = command("bench", "env=walker2d", "num_envs=16", "seconds=0.5", f"out={tmp_path}/bench.json")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "bench.json").read_text())
    results = content["results"]
    speeds = ("Gymnasium, one core", "physics only", "physics, observation and reward", "training")
    assert all(results[name] > 100 for name in speeds)
    assert results["compile and first update, cold cache"] > 0 and results["peak memory, host"] > 0.1
    assert content["env"] == "Walker2d-v5" and content["versions"]["mujoco"] and "16 copies" in content["device"]
