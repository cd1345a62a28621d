"""Training commands that a campaign kills: a server imports the package once and forks a process for each command."""

import contextlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from helpers import ENVIRONMENT, TINY, TINY_OFF_POLICY, saved_leaves

from mjx_walk.storage import checkpoint
from mjx_walk.storage.scores import POLICIES

HANG = 180.0
"""Seconds after which a command counts as hanging."""
CALLS = 40
"""Program calls of a run."""
EACH_CALL = ("checkpoint.every_calls=1", "algo.policy_hidden_layer_sizes=[16]")
RUNS = {
    "ppo": (*TINY, *EACH_CALL),
    "sac": (*TINY_OFF_POLICY, "algo=sac", *EACH_CALL),
    "csac": (*TINY_OFF_POLICY, "algo=csac", *EACH_CALL),
    "td3": (*TINY_OFF_POLICY, "algo=td3", *EACH_CALL),
    "seeds": (*TINY, *EACH_CALL, "seeds=2"),
    "devices": (*TINY, *EACH_CALL, "devices=2"),
}


class Command:
    """A command in a process of its own, with its own group. Its output goes to a file."""

    def __init__(self, server, pid, output):
        self._server, self._output = server, output
        self.pid = pid
        self._descriptor = os.pidfd_open(pid)

    @property
    def is_running(self):
        return not select.select([self._descriptor], [], [], 0)[0]

    def kill(self, number=signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def wait(self):
        """The exit code, negative after a signal; None if the command hangs."""
        hangs = not select.select([self._descriptor], [], [], HANG)[0]
        if hangs:
            self.kill()
        code = self._server.code_of(self.pid)
        os.close(self._descriptor)
        return None if hangs else code

    @property
    def printed(self):
        return self._output.read_text(errors="replace")


class Server:
    """Starts `python -m mjx_walk.train` without the seconds that the imports take."""

    def __init__(self, folder):
        self._folder, self._count = folder, 0
        script = [sys.executable, str(Path(__file__)), "serve"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        path = os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(Path(__file__).parent)])
        self._process = subprocess.Popen(script, env=ENVIRONMENT | {"PYTHONPATH": path}, **pipes)

    def start(self, *arguments):
        self._count += 1
        output = self._folder / f"output_{self._count}.txt"
        return Command(self, self._ask("start", str(output), *arguments), output)

    def code_of(self, pid):
        return self._ask("wait", pid)

    def _ask(self, *words):
        print(json.dumps(words), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def close(self):
        self._process.stdin.close()
        self._process.wait()


def serve():
    """Answer the requests of a `Server` on the standard streams."""
    import matplotlib.pyplot  # noqa: F401

    import mjx_walk.train
    import mjx_walk.viewing.run_plots  # noqa: F401

    while line := sys.stdin.readline():
        what, *words = json.loads(line)
        if what == "wait":
            answer = os.waitstatus_to_exitcode(os.waitpid(words[0], 0)[1])
        else:
            answer = os.fork()
            if not answer:
                run_as_command(*words)
        print(json.dumps(answer), flush=True)


def run_as_command(output, *arguments):
    """Become `python -m mjx_walk.train ARGUMENTS`, in a session of its own."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    stream = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for number in (1, 2):
        os.dup2(stream, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.argv = ["mjx_walk.train", *arguments]
    sys.modules.pop("mjx_walk.train")
    runpy.run_module("mjx_walk.train", run_name="__main__", alter_sys=True)


def arguments_of(name, run_dir):
    steps = CALLS * 64 * (2 if name == "devices" else 1)
    return [*RUNS[name], f"run_dir={run_dir}", f"total_steps={steps}"]


def resumed(name, run_dir):
    """The same command, which resumes a run that has begun."""
    has_begun = any(path.stat().st_size for path in run_dir.rglob("config.yaml"))
    return [*arguments_of(name, run_dir), *(["resume=true"] if has_begun else [])]


def trained(server, name, run_dir):
    """A run that nothing has disturbed."""
    done = server.start(*arguments_of(name, run_dir))
    assert done.wait() == 0, done.printed
    return run_dir


def num_rows(run_dir):
    try:
        return (run_dir / "metrics.jsonl").read_bytes().count(b"\n")
    except FileNotFoundError:
        return 0


def wait_for_new_rows(command, run_dir, count):
    """Wait until a command has logged some rows, or has ended."""
    last, logged = num_rows(run_dir), 0
    deadline = time.monotonic() + HANG
    while logged < count and command.is_running and time.monotonic() < deadline:
        time.sleep(0.005)
        now = num_rows(run_dir)
        logged, last = logged + max(now - last, 0), now


def differences(run_dir, reference):
    """What differs between two finished runs: leaves, policies, rows."""
    found = []
    folders = [path.relative_to(reference) for path in reference.rglob("checkpoints")]
    for folder in folders:
        last = checkpoint.list_steps(reference / folder)[-1].name
        for name in (last, *POLICIES):
            if not (reference / folder / name).exists():
                continue
            expected = saved_leaves(reference / folder / name)
            leaves = saved_leaves(run_dir / folder / name) if (run_dir / folder / name).exists() else {}
            same = leaves.keys() == expected.keys()
            if not same or not all(np.array_equal(leaves[x], expected[x], equal_nan=True) for x in expected):
                found.append(str(folder / name))
        log = folder.parent / "metrics.jsonl"
        if rows(run_dir / log) != rows(reference / log):
            found.append(str(log))
    return found


def rows(path):
    """All rows without what depends on the time."""
    found = [json.loads(line) for line in path.read_text().splitlines()]
    return [{k: v for k, v in row.items() if k != "wall_seconds" and not k.startswith("speed/")} for row in found]


class Tally:
    """What a campaign has tried, and how it ended."""

    def __init__(self, name):
        self.name, self.tried = name, 0
        self.bad = {"lost": [], "hangs": [], "tracebacks": [], "silent differences": []}

    def check(self, command, code, fine):
        """Note how a command has ended. Returns whether that was well."""
        if code is None:
            self.bad["hangs"].append(command.printed)
        elif "Traceback" in command.printed:
            self.bad["tracebacks"].append(command.printed)
        elif code not in fine:
            self.bad["lost"].append(f"{code}: {command.printed}")
        else:
            return True
        return False

    def report(self):
        counts = ", ".join(f"{name} {len(found)}" for name, found in self.bad.items())
        survived = self.tried - sum(map(len, self.bad.values()))
        print(f"\n{self.name}: tried {self.tried}, survived {survived}, {counts}", flush=True)
        assert not any(self.bad.values()), json.dumps(self.bad, indent=1)[:20_000]


if __name__ == "__main__":
    serve()
