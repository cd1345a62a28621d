"""The notebook runs from its first cell to its last, and is kept without outputs."""

import contextlib
import re
import sys
import types
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from packaging.requirements import Requirement

NOTEBOOK = Path(__file__).parent.parent / "notebooks" / "walk.ipynb"


def test_outputs_are_stripped():
    cells = [cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]
    assert len(cells) > 5 and not any(cell.outputs or cell.execution_count for cell in cells)


WHEEL = "mjx_walk-1.0-py3-none-any.whl"


SOURCES = [
    (WHEEL, False, "{source}{extra}"),
    (f"https://example.org/{WHEEL}", False, "mjx-walk{extra} @ {source}"),
    ("https://example.org/mjx_walk", False, "mjx-walk{extra} @ git+{source}"),
    ("", True, "..{extra}"),
]
DRIVERS = [(None, ""), ("580.95.05", "[cuda]"), ("550.54.14", "[cuda12]"), ("470.1", "")]


@pytest.mark.parametrize(("driver", "extra"), DRIVERS)
@pytest.mark.parametrize(("source", "in_clone", "installed"), SOURCES)
def test_the_first_cell_installs_what_the_driver_supports(
    tmp_path, monkeypatch, source, in_clone, installed, driver, extra
):
    ran = run_first_cell(tmp_path, monkeypatch, source, in_clone, driver)
    expected = installed.format(source=source, extra=extra)
    assert ran == [[sys.executable, "-m", "pip", "install", "--quiet", expected]]
    if "@" in expected:
        assert Requirement(expected).name == "mjx-walk"


def test_the_first_cell_keeps_to_the_cuda_that_is_installed(tmp_path, monkeypatch):
    ran = run_first_cell(tmp_path, monkeypatch, WHEEL, False, "580.95.05", has_cuda_12=True)
    assert ran[0][-1] == f"{WHEEL}[cuda12]"


def test_the_first_cell_says_what_it_needs(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="Set SOURCE above to mjx_walk's wheel"):
        run_first_cell(tmp_path, monkeypatch, "", in_clone=False)


@pytest.mark.parametrize(("uploaded", "ends"), [({WHEEL: b""}, False), ({"other.txt": b""}, True), ({}, True)])
def test_colab_asks_for_the_wheel(tmp_path, monkeypatch, uploaded, ends):
    colab = types.ModuleType("google.colab")
    colab.files = types.SimpleNamespace(upload=lambda: uploaded)
    monkeypatch.setitem(sys.modules, "google.colab", colab)
    with pytest.raises(SystemExit) if ends else contextlib.nullcontext():
        assert run_first_cell(tmp_path, monkeypatch, "", in_clone=False)[0][-1] == WHEEL


def run_first_cell(tmp_path, monkeypatch, source, in_clone, driver=None, has_cuda_12=False):
    """Run it as if mjx_walk were not installed. Returns the commands that it would run."""
    cell = next(cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code")
    (tmp_path / "notebooks").mkdir()
    if in_clone:
        (tmp_path / "pyproject.toml").touch()
    monkeypatch.chdir(tmp_path / "notebooks")
    ran = []

    def run(command, **options):
        if command[0] != "nvidia-smi":
            return ran.append(command)
        if driver is None:
            raise FileNotFoundError
        return types.SimpleNamespace(stdout=f"{driver}\n")

    monkeypatch.setattr("importlib.util.find_spec", lambda name: ("jax" in name and has_cuda_12) or None)
    monkeypatch.setattr("subprocess.run", run)
    exec(cell.source.replace('SOURCE = ""', f"SOURCE = {source!r}"), {})
    return ran


@pytest.mark.slow
def test_it_runs_on_a_cpu(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    parameters.source += (
        "\nSTEPS = 40_000\nOPTIONS = [*OPTIONS[:2], f'total_steps={STEPS}', 'evaluation.gymnasium_episodes=2']"
    )
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    texts = {kind: [] for kind in ("stream", "display_data", "execute_result")}
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            texts[output.output_type].append(output.get("text") or output.data)
    printed = "".join(texts["stream"])
    assert "Warning" not in printed, printed
    assert "cpu: cpu; physics on the engine 'c'" in printed
    (score,) = re.findall(r"Walker2d-v5: ([\d,.]+) ± [\d,.]+ over 10 episodes", printed)
    assert float(score.replace(",", "")) > 100
    assert len(re.findall(r"(?:first|gentle) +\d+ steps, +-?[\d.]+ m/s, torque +[\d.]+ N·m", printed)) == 2
    shown = texts["display_data"] + texts["execute_result"]
    assert any("video" in data.get("text/html", "") for data in shown) and any("image/png" in data for data in shown)
