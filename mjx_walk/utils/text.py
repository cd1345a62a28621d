"""Numbers as people read them."""

from typing import SupportsFloat

__all__ = ["format_score"]


def format_score(value: SupportsFloat | None) -> str:
    """A return or a score with three digits or more: `13,310`, `143.7`, `-3.94`. None is a dash."""
    if value is None:
        return "–"
    number = float(value)
    size = abs(number)
    return f"{number:,.{0 if size >= 1000 else 1 if size >= 10 else 2}f}"
