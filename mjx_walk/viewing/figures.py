"""The style of all figures, which a `matplotlibrc` in the working directory does not change."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import matplotlib.figure
import matplotlib.style

from mjx_walk.storage.files import replacing

__all__ = ["save_figure", "standard_style"]


@contextlib.contextmanager
def standard_style() -> Iterator[None]:
    """Context manager and decorator for drawing. Names of metrics and bodies are shown as they are, not as formulas.

    A downloaded folder may bring a `matplotlibrc`, which could even hand text to LaTeX.
    """
    with matplotlib.style.context(["default", {"text.parse_math": False}]):
        yield


def save_figure(figure: matplotlib.figure.Figure, path: Path, dpi: int = 110) -> Path:
    """Write a figure to a file, atomically. Returns the file's path."""
    with replacing(path) as new:
        figure.savefig(new, dpi=dpi)
    return path
