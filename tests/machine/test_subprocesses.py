"""Child processes import what their parent imports."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import CLONE

from mjx_walk.machine.devices import count_devices
from mjx_walk.viewing import rendering

START = (
    f"import sys; sys.path.insert(0, {str(CLONE)!r})\n"
    "from mjx_walk.machine.subprocesses import start_module\n"
    "start_module('evaluation.gymnasium_worker', stdin=-3).wait()\n"
)


@pytest.mark.parametrize("parent", ["-P", "a script elsewhere", "-c"])
def test_a_child_imports_from_the_working_directory_only_what_its_parent_would(tmp_path, parent):
    (tmp_path / "numpy.py").write_text("import pathlib\npathlib.Path('ran').touch()\n")
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    (tmp_path / "elsewhere").mkdir()
    script = tmp_path / "elsewhere" / "script.py"  # as an installed command, which lies in another folder
    script.write_text(START)
    # The parent itself has imported NumPy from its usual place.
    program = START.replace("import sys;", "import sys; sys.path.remove(''); import numpy; sys.path.insert(0, '');")
    arguments = {"-P": ["-P", "-c", START], "a script elsewhere": [str(script)], "-c": ["-c", program]}[parent]
    subprocess.run([sys.executable, *arguments], cwd=tmp_path, env=env, stderr=subprocess.DEVNULL, check=False)
    assert (tmp_path / "ran").exists() == (parent == "-c")


@pytest.mark.parametrize("ask", [count_devices, lambda: rendering._works.__wrapped__("egl")])
def test_a_question_to_a_child_runs_nothing_of_the_working_directory(tmp_path, monkeypatch, ask):
    for name in ("jax", "mujoco"):
        (tmp_path / f"{name}.py").write_text("import pathlib\npathlib.Path('ran').touch()\nprint(False, 1)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    ask()
    assert not (tmp_path / "ran").exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells a process that its parent has ended")
@pytest.mark.parametrize("asked", [True, False])
def test_a_child_ends_with_a_killed_parent_that_asked_for_it(asked):
    child = (
        "from mjx_walk.machine.subprocesses import end_with_parent as e; import time; e(); print('up'); time.sleep(60)"
    )
    parent = (
        "import os, subprocess, sys; from mjx_walk.machine.subprocesses import with_parent\n"
        f"env = os.environ | (with_parent() if {asked} else {{}})\n"
        f"child = subprocess.Popen([sys.executable, '-uc', {child!r}], env=env, stdout=subprocess.PIPE)\n"
        "child.stdout.readline(); print(child.pid, flush=True); child.wait()\n"
    )
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, cwd=CLONE, text=True)
    pid = int(process.stdout.readline())
    process.kill()
    process.wait()
    deadline = time.monotonic() + (10 if asked else 0.5)
    while _is_running(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert _is_running(pid) != asked
    if not asked:
        os.kill(pid, signal.SIGKILL)


def _is_running(pid):
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False
