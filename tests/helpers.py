"""Run the commands as a user does, small."""

import contextlib
import dataclasses
import json
import os
import re
import runpy
import subprocess
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import orbax.checkpoint as ocp
import pytest
from shared_programs import shared_programs

from mjx_walk.algos import ALGORITHMS
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.envs import registry
from mjx_walk.storage import checkpoint
from mjx_walk.storage.checkpoint_metadata import read_metadata, write_metadata
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing import rendering

CLONE = Path(__file__).parent.parent
PAGES = {path: path.read_text() for path in (CLONE / "README.md", *sorted((CLONE / "docs").rglob("*.md")))}
"""README and the pages of the documentation, by their paths."""
OLD_RUNS = CLONE / "tests" / "storage" / "old_runs"
"""A run folder of each algorithm, written by an earlier version."""

TINY = (
    "env=walker2d",
    "num_envs=8",
    "evaluation.num_envs=2",
    "evaluation.gymnasium_episodes=0",
    "algo.unroll_length=8",
    "algo.normalizer_warmup_steps_per_env=8",
    "algo.num_minibatches=2",
    "algo.num_epochs=2",
    "checkpoint.every_calls=2",
)
TINY_OFF_POLICY = (
    "env=walker2d",
    "env.max_episode_steps=30",
    "num_envs=8",
    "iterations_per_call=8",
    "evaluation.num_envs=2",
    "evaluation.gymnasium_episodes=0",
    "algo.unroll_length=1",
    "algo.grad_updates_per_step=2",
    "algo.batch_size=16",
    "algo.replay_capacity=256",
    "algo.learning_starts=64",
    "algo.policy_hidden_layer_sizes=[32,32]",
    "algo.critic_hidden_layer_sizes=[32,32]",
    "checkpoint.every_calls=2",
)
_SMALL_ON_POLICY = {
    "unroll_length": 4,
    "num_unrolls": 1,
    "normalizer_warmup_steps_per_env": 4,
    "num_minibatches": 2,
    "max_tail_discount": 0.95,
    "policy_hidden_layer_sizes": (4,),
    "value_hidden_layer_sizes": (4,),
}
_SMALL_OFF_POLICY = {
    "unroll_length": 2,
    "grad_updates_per_step": 1,
    "policy_delay": 1,
    "batch_size": 4,
    "replay_capacity": 64,
    "learning_starts": 8,
    "policy_hidden_layer_sizes": (4,),
    "critic_hidden_layer_sizes": (4,),
}
ON_POLICY = [name for name, (_, config) in ALGORITHMS.items() if issubclass(config, OnPolicyConfig)]
OFF_POLICY = [name for name in ALGORITHMS if name not in ON_POLICY]
OPTIMIZED = {"xla_backend_optimization_level": 1}
"""Options of `jax.jit` for programs that take longer to run than to compile; see `conftest`."""

TINY_CALL = 8 * 8
"""Environment steps of one call, with either list of settings."""


ENVIRONMENT = os.environ | {"PYTHONPATH": str(CLONE)}


def command(module: str, *arguments: str, **kwargs) -> subprocess.CompletedProcess:
    """`python -m mjx_walk.MODULE ARGUMENTS`, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", f"mjx_walk.{module}", *arguments],
        capture_output=True,
        text=True,
        timeout=kwargs.pop("timeout", 600),
        env=ENVIRONMENT | kwargs.pop("env", {}),
        check=False,
        **kwargs,
    )


def start(module: str, *arguments: str, seconds=300, env=None, **kwargs) -> subprocess.Popen:
    """`command`, left running. Its output and its errors are one stream. It is killed after so many seconds."""
    process = subprocess.Popen(
        [sys.executable, "-m", f"mjx_walk.{module}", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=ENVIRONMENT | (env or {}),
        **kwargs,
    )
    kill_after(process, seconds)
    return process


def kill_after(process: subprocess.Popen, seconds: float) -> None:
    """Kill a process if it is still running after so many seconds."""
    limit = threading.Timer(seconds, process.kill)
    limit.daemon = True
    limit.start()


def wait_for_line(process: subprocess.Popen, text: str) -> str:
    """Block until a started command prints a line that contains a text. Returns the line."""
    printed = []
    for line in process.stdout:
        printed.append(line)
        if text in line:
            return line
    raise AssertionError(f"ended before '{text}':\n{''.join(printed)}")


def wait_for_rows(process: subprocess.Popen, run_dir: Path, count: int) -> None:
    """Block until a started command has logged that many calls to a run folder that it creates."""
    with following(process, run_dir) as lines:
        rows = [next(lines, "") for _ in range(count)]
    assert all(rows), finish(process)


def wait_for_row(process: subprocess.Popen, run_dir: Path, is_it: Callable[[dict], bool]) -> None:
    """Block until a started command has logged a row of that kind, or has ended."""
    with following(process, run_dir) as lines:
        any(is_it(json.loads(line)) for line in lines)


@contextlib.contextmanager
def following(process: subprocess.Popen, run_dir: Path) -> Iterator[Iterator[str]]:
    """The lines of a run's `metrics.jsonl`, as they are written, until the process ends."""
    follow = ["tail", f"--pid={process.pid}", "--lines=+1", "--follow=name", "--retry", str(run_dir / "metrics.jsonl")]
    with subprocess.Popen(follow, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as tail:
        yield iter(tail.stdout)
        tail.kill()


def finish(process: subprocess.Popen) -> str:
    """Wait for a started command to end. Returns the rest of its output."""
    rest = process.stdout.read()
    process.wait()
    return rest


def command_here(module: str, *arguments: str) -> int:
    """Exit code of `command`, run in this process, which has the imports and programs already."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "argv", [f"mjx_walk.{module}", *arguments])
        patched.delitem(sys.modules, f"mjx_walk.{module}", raising=False)  # else runpy warns
        with pytest.raises(SystemExit) as ended:
            runpy.run_module(f"mjx_walk.{module}", run_name="__main__", alter_sys=True)
    return ended.value.code


def used_settings(algo):
    """Names of the settings of an algorithm, without inherited ones that never have an effect."""
    return {field.name for field in dataclasses.fields(ALGORITHMS[algo][1]) if field.metadata.get("only_if") != {}}


def small_settings(algo, **further):
    """Settings of an algorithm that make an iteration small, and further ones."""
    config = ALGORITHMS[algo][1]
    small = _SMALL_ON_POLICY if issubclass(config, OnPolicyConfig) else _SMALL_OFF_POLICY
    names = {field.name for field in dataclasses.fields(config)}
    return {name: value for name, value in small.items() if name in names} | further


def leaves(run_dir, call):
    return saved_leaves(checkpoint.step_path(run_dir / "checkpoints", call * TINY_CALL))


def saved_leaves(path):
    """All leaves of a checkpoint, read without the package."""
    found = {}
    for part in (path / "arrays", path / "replay", path / "snapshots"):
        if (part / "arrays.npz").exists():
            with np.load(part / "arrays.npz") as arrays:
                found |= dict(arrays)
        elif part.exists():
            with ocp.PyTreeCheckpointer() as checkpointer:
                found |= checkpointer.restore(part)
    return found


def train_here(run_dir, *arguments, tiny=TINY):
    """Train in this process. Curves are not drawn, which would take a quarter of the time."""
    with pytest.MonkeyPatch.context() as patched, shared_programs():
        patched.setattr("mjx_walk.viewing.run_plots.plot_run", lambda folder: None)
        assert command_here("train", *tiny, f"run_dir={run_dir}", *arguments) == 0


def train(run_dir, *arguments, tiny=TINY):
    done = command("train", *tiny, f"run_dir={run_dir}", *arguments)
    assert done.returncode == 0, done.stderr
    return done


def flip_a_byte(folder):
    """Damage the largest data file."""
    path = max((folder / "arrays" / "d").iterdir(), key=lambda p: p.stat().st_size)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


def edit_config(run_dir, old, new):
    """Change the configuration of a run and all copies of it, with their checksums, as a stranger could."""
    for path in (run_dir / "config.yaml", *run_dir.rglob("run_config.yaml")):
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        meta = path.parent / "meta.json"
        if meta.exists():
            write_metadata(meta, read_metadata(meta) | {"config_crc32": zlib.crc32(path.read_bytes())})


@contextlib.contextmanager
def unregistered():
    """Forget the tasks and algorithms that are registered inside the block."""
    tables = (registry.TASKS, registry._files, ALGORITHMS)
    former = [dict(table) for table in tables]
    try:
        yield
    finally:
        for table, content in zip(tables, former, strict=True):
            table.clear()
            table.update(content)


def can_render():
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("MUJOCO_GL", "")
        patched.delenv("MUJOCO_GL")
        try:
            rendering.choose_opengl()
        except UserError:
            return False
        return True


renders = pytest.mark.skipif(not can_render(), reason="nothing to render with: install libegl1 and libopengl0")


def blocks(language):
    """The fenced blocks of README and the documentation in a language."""
    return [block for text in PAGES.values() for block in fenced(text, language)]


def fenced(text, language):
    """The fenced blocks of a page in a language; `""` for those that name none."""
    found = re.findall(r"^```(\S*)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    return [block for name, block in found if name == language]


def slow_except(fast, cases):
    """The cases for `parametrize`, of which all but the fast ones are slow tests."""
    cases = list(cases)
    assert set(fast) <= set(cases)
    return [case if case in fast else pytest.param(case, marks=pytest.mark.slow) for case in cases]


def values(metrics):
    """The numbers of metrics, by their names."""
    return {name: metric.value for name, metric in metrics.items()}
