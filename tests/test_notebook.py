"""The notebook runs from its first cell to its last, and is kept without outputs."""

import re
import sys
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


@pytest.mark.parametrize("has_gpu", [False, True])
@pytest.mark.parametrize(
    ("source", "in_clone", "installed"),
    [
        (WHEEL, False, "{source}{extra}"),
        (f"https://example.org/{WHEEL}", False, "mjx-walk{extra} @ {source}"),
        ("https://example.org/mjx_walk", False, "mjx-walk{extra} @ git+{source}"),
        ("", True, "..{extra}"),
    ],
)
def test_the_first_cell_installs_the_package(tmp_path, monkeypatch, source, in_clone, installed, has_gpu):
    ran = run_first_cell(tmp_path, monkeypatch, source, in_clone, has_gpu)
    expected = installed.format(source=source, extra="[cuda]" if has_gpu else "")
    assert ran == [[sys.executable, "-m", "pip", "install", "--quiet", expected]]
    if "@" in expected:
        assert Requirement(expected).name == "mjx-walk"


def test_the_first_cell_says_what_it_needs(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="Set SOURCE above to mjx_walk's wheel"):
        run_first_cell(tmp_path, monkeypatch, "", in_clone=False, has_gpu=False)


def run_first_cell(tmp_path, monkeypatch, source, in_clone, has_gpu):
    """Run it as if mjx_walk were not installed. Returns the commands that it would run."""
    cell = next(cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code")
    (tmp_path / "notebooks").mkdir()
    if in_clone:
        (tmp_path / "pyproject.toml").touch()
    monkeypatch.chdir(tmp_path / "notebooks")
    ran = []
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/nvidia-smi" if has_gpu else None)
    monkeypatch.setattr("subprocess.run", lambda command, check: ran.append(command))
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
