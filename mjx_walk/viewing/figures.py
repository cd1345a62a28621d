"""The style of all figures, which a `matplotlibrc` in the working directory does not change."""

import contextlib
from collections.abc import Iterator

import matplotlib.style

__all__ = ["standard_style"]


@contextlib.contextmanager
def standard_style() -> Iterator[None]:
    """Context manager and decorator for drawing. Names of metrics and bodies are shown as they are, not as formulas.

    A downloaded folder may bring a `matplotlibrc`, which could even hand text to LaTeX.
    """
    with matplotlib.style.context(["default", {"text.parse_math": False}]):
        yield
