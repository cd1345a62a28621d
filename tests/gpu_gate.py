"""Commands on GPUs for the parts of the gate, and the table of what passed.

`conftest` keeps the tests' own process on the CPU. Every part starts the commands as a user would, on a GPU.
"""

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import CLONE, kill_after

from mjx_walk.logs.metrics import read_rows

_NOT_FOR_USERS = ("JAX_PLATFORMS", "XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "XDG_CONFIG_HOME")
"""Variables by which `conftest` makes tests run on a CPU, compile quickly and leave the user's files alone."""
_SHARED = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "JAX_COMPILATION_CACHE_DIR": "/tmp/mjx_walk_gpu_gate"}
_SECONDS = 420


def gpus() -> list[str]:
    """The GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` names them."""
    if "CUDA_VISIBLE_DEVICES" in os.environ:
        return [name for name in os.environ["CUDA_VISIBLE_DEVICES"].split(",") if name]
    try:
        listed = subprocess.run(["nvidia-smi", "--list-gpus"], capture_output=True, text=True, check=False).stdout
    except FileNotFoundError:
        return []
    return [str(index) for index in range(listed.count("GPU "))]


def on_gpus(count: int = 1) -> dict[str, str]:
    """The environment of a command that sees that many GPUs. Workers of pytest-xdist take turns.

    A part that needs more GPUs than there are is skipped. Without any GPU, it fails.
    """
    found = gpus()
    assert found, "the gate needs an NVIDIA GPU"
    if count > len(found):
        pytest.skip(f"{count} GPUs; this machine has {len(found)}")
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    chosen = [found[(worker + place) % len(found)] for place in range(count)]
    kept = {name: value for name, value in os.environ.items() if name not in _NOT_FOR_USERS}
    paths = os.pathsep.join(filter(None, [str(CLONE), os.environ.get("PYTHONPATH")]))
    return kept | _SHARED | {"PYTHONPATH": paths, "CUDA_VISIBLE_DEVICES": ",".join(chosen)}


def require(*modules: str) -> None:
    """Skip the part if this machine lacks a library, and name it."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"missing: {', '.join(missing)}")


def start(module: str, *arguments: str, count: int = 1, **options) -> subprocess.Popen:
    """Start `python -m mjx_walk.MODULE ARGUMENTS` on that many GPUs. Its output and its errors are one stream.

    It is killed after `_SECONDS`.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", f"mjx_walk.{module}", *arguments],
        env=on_gpus(count),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )
    kill_after(process, _SECONDS)
    return process


def finish(process: subprocess.Popen) -> str:
    """Wait for a command. Returns its output, after it has ended with 0."""
    output, _ = process.communicate()
    assert process.returncode != -signal.SIGKILL, f"killed, at the latest after {_SECONDS} s:\n{output[-3000:]}"
    assert process.returncode == 0, f"{process.args}\n{output[-6000:]}"
    return output


def run(module: str, *arguments: str, count: int = 1, **options) -> str:
    """The output of a command."""
    return finish(start(module, *arguments, count=count, **options))


def run_python(code: str, *arguments: str, **options) -> str:
    """The output of a Python program on a GPU."""
    program = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(
        program, env=on_gpus(), capture_output=True, text=True, timeout=_SECONDS, check=False, **options
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-6000:]
    return done.stdout


def checked_rows(run_dir: Path, num_calls: int) -> list[dict]:
    """The metrics of a run of that many calls, with rising steps, no overflow and no state that is not finite."""
    rows = read_rows(run_dir / "metrics.jsonl")
    assert len(rows) == num_calls, [row["env_steps"] for row in rows]
    steps = [row["env_steps"] for row in rows]
    assert steps == sorted(set(steps))
    for row in rows:
        assert row["physics/overflow"] == 0 and row["physics/nonfinite"] == 0, row
    return rows


def write_table(reporter, reports) -> None:
    """Write a row for each part: its outcome, its seconds, and what it measured or why it was skipped."""
    reporter.section("GPU gate")
    reporter.write_line(f"GPUs: {_names()}")
    reporter.write_line("| Part | Outcome | Seconds | Measured |\n| --- | --- | ---: | --- |")
    for report in sorted(reports, key=lambda report: report.nodeid):
        part = report.nodeid.rpartition("::")[2].removeprefix("test_")
        measured = dict(report.user_properties).get("measured", "")
        if report.skipped:
            measured = report.longrepr[2].removeprefix("Skipped: ")
        reporter.write_line(f"| {part} | {report.outcome} | {report.duration:.0f} | {measured} |")


def _names() -> str:
    if not gpus():
        return "none"
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    return "; ".join(subprocess.run(query, capture_output=True, text=True, check=False).stdout.splitlines())
