"""The notebook runs from its first cell to its last, and is kept without outputs."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parent.parent / "notebooks" / "walk.ipynb"


def test_outputs_are_stripped():
    cells = [cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]
    assert len(cells) > 5 and not any(cell.outputs or cell.execution_count for cell in cells)


@pytest.mark.slow
def test_it_runs_on_a_cpu(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    parameters.source += (
        "\nSTEPS = 150_000\nOPTIONS = [*OPTIONS[:2], f'total_steps={STEPS}', 'evaluation.gymnasium_episodes=2']"
    )
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    texts = {kind: [] for kind in ("stream", "display_data", "execute_result")}
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            texts[output.output_type].append(output.get("text") or output.data)
    printed = "".join(texts["stream"])
    assert "cpu: cpu; physics on the engine 'c'" in printed
    (score,) = re.findall(r"Walker2d-v5: ([\d,.]+) ± [\d,.]+ over 10 episodes", printed)
    assert float(score.replace(",", "")) > 100
    assert len(re.findall(r"(?:first|gentle) +\d+ steps, +-?[\d.]+ m/s, torque +[\d.]+ N·m", printed)) == 2
    shown = texts["display_data"] + texts["execute_result"]
    assert any("video" in data.get("text/html", "") for data in shown) and any("image/png" in data for data in shown)
