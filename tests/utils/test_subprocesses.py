"""Child processes import what their parent imports."""

import os
import subprocess
import sys

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
