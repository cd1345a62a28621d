"""The figure of a policy's robustness: its mean return for each change of the physics."""

from pathlib import Path

import matplotlib.figure
import numpy as np

from mjx_walk.evaluation.robustness import STRENGTHS, Robustness
from mjx_walk.utils.text import format_score
from mjx_walk.viewing.figures import save_figure, standard_style

__all__ = ["draw_robustness"]


@standard_style()
def draw_robustness(robustness: Robustness, path: Path) -> None:
    """Draw a row for each kind of change, from weak to strong. Colors go from the lowest mean return to the nominal."""
    means = np.array([cell.mean for cell in robustness.single]).reshape(len(STRENGTHS), -1)
    highest = max(robustness.nominal.mean, means.max())
    lowest = min(means.min(), 0.0) if highest > 0 else means.min()
    figure = matplotlib.figure.Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(means, cmap="RdYlBu", vmin=lowest, vmax=highest, aspect="auto", alpha=0.75)
    for i, cell in enumerate(robustness.single):
        row, column = divmod(i, means.shape[1])
        axes.text(column, row, f"{cell.label}\n{format_score(cell.mean)}", ha="center", va="center", fontsize=10)
    axes.set_yticks(range(len(STRENGTHS)), list(STRENGTHS))
    axes.set_xticks([])
    axes.set_xlabel("weak to strong change")
    axes.set_title(
        f"{robustness.env}: mean return of {len(robustness.nominal.returns)} episodes a cell\n"
        f"nominal {format_score(robustness.nominal.mean)}, area {format_score(robustness.area)}, "
        f"all together {format_score(robustness.together.mean)}",
        fontsize=11,
    )
    save_figure(figure, path)
