"""Child processes import what their parent imports."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import CLONE

START = (
    f"import sys; sys.path.insert(0, {str(CLONE)!r})\n"
    "from mjx_walk.utils.subprocesses import start_module\n"
    "start_module('evaluation.gymnasium_worker', stdin=-3).wait()\n"
)


@pytest.mark.parametrize("safe", [True, False])
def test_a_child_of_a_safe_parent_imports_nothing_from_the_working_directory(tmp_path, safe):
    (tmp_path / "numpy.py").write_text("import pathlib\npathlib.Path('ran').touch()\n")
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    # The parent imports nothing from there in either case.
    program = f"{START if safe else START.replace('import sys;', 'import sys; sys.path.remove(str());')}"
    arguments = [sys.executable, *(["-P"] if safe else []), "-c", program]
    subprocess.run(arguments, cwd=tmp_path, env=env, stderr=subprocess.DEVNULL, check=False)
    assert (tmp_path / "ran").exists() != safe


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells a process that its parent has ended")
@pytest.mark.parametrize("asked", [True, False])
def test_a_child_ends_with_a_killed_parent_that_asked_for_it(asked):
    child = (
        "from mjx_walk.utils.subprocesses import end_with_parent as e; import time; e(); print('up'); time.sleep(60)"
    )
    parent = (
        "import os, subprocess, sys; from mjx_walk.utils.subprocesses import with_parent\n"
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
