"""Tests run on the CPU, share one compile cache within a run, and have XLA compile quickly.

Most programs here take longer to compile than to run, and programs that call back into Python, as MuJoCo's C library
does, are in no cache. `_QUICK_COMPILE` cuts compile times. `helpers.OPTIMIZED` is for programs that run for long.
`SAFE_REDUCTIONS` is set here, because tests use JAX before they call anything that sets it. With `CHECK_SHAPES=1` in
the environment, the shapes in the signatures of `algos` and `common` are checked at every call.
"""

import atexit
import gc
import os
import random
import shutil
import tempfile

import pytest
from shapes import check_rooms
from xla_flags import SAFE_REDUCTIONS, quick_compile

if os.environ.get("CHECK_SHAPES") == "1":
    check_rooms()
os.environ["JAX_PLATFORMS"] = "cpu"
_QUICK_COMPILE = quick_compile(0)


def _temporary_folder() -> str:
    """A folder that lasts as long as this process."""
    path = tempfile.mkdtemp(prefix="mjx_walk_tests_")
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return path


os.environ["XDG_CONFIG_HOME"] = _temporary_folder()
_FLAGS = os.environ.get("XLA_FLAGS", "")
if _QUICK_COMPILE not in _FLAGS:  # pytest-xdist's workers inherit the flags
    os.environ["XLA_FLAGS"] = f"{_QUICK_COMPILE} {SAFE_REDUCTIONS} {_FLAGS}".rstrip()
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _temporary_folder()
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def pytest_collection_finish():
    """Spare Python the repeated search of what never becomes garbage: MJX's half million objects, JAX's programs."""
    gc.freeze()
    gc.set_threshold(200_000, 20, 100)


def pytest_addoption(parser):
    parser.addoption("--faults", type=int, default=200, help="kills, and damages, of `-m campaign`")
    parser.addoption("--fault-seed", default="0", help="seed of the random faults")


def pytest_terminal_summary(terminalreporter):
    """Print the table of the GPU gate."""
    from gpu_gate import write_table

    reports = [report for reports in terminalreporter.stats.values() for report in reports if is_gpu_part(report)]
    if reports:
        write_table(terminalreporter, reports)


def is_gpu_part(report):
    """Whether it is a report, not a test that was left out, and the outcome of a part of the GPU gate."""
    if not isinstance(report, pytest.TestReport):
        return False
    return "gpu" in report.keywords and (report.when == "call" or report.outcome != "passed")


@pytest.fixture
def rng(request):
    """Random numbers of a campaign of faults."""
    return random.Random(f"{request.config.getoption('--fault-seed')} {request.node.name}")


@pytest.fixture
def num_faults(request):
    return request.config.getoption("--faults")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    from faults import Server

    server = Server(tmp_path_factory.mktemp("output"))
    yield server
    server.close()
