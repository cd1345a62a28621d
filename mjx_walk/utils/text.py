"""Numbers and times as people read them."""

from typing import SupportsFloat

__all__ = ["duration", "format_score"]


def format_score(value: SupportsFloat | None) -> str:
    """A return or a score with three digits or more: `13,310`, `143.7`, `-3.94`. None is a dash."""
    if value is None:
        return "–"
    number = float(value)
    size = abs(number)
    return f"{number:,.{0 if size >= 1000 else 1 if size >= 10 else 2}f}"


def duration(seconds: float) -> str:
    """Seconds as text: `48 s`, `4 min 41 s`, `1 h 2 min`."""
    total = round(seconds)
    if total < 60:
        return f"{total} s"
    if total < 3600:
        return f"{total // 60} min {total % 60} s"
    return f"{total // 3600} h {total % 3600 // 60} min"
