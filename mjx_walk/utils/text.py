"""Numbers and times as people read them, and text of strangers that is safe to show."""

import re
import unicodedata
from typing import SupportsFloat

__all__ = ["duration", "format_score", "has_controls", "in_markdown", "printable"]

_CONTROLS = ("Cc", "Cs", "Zl", "Zp")
"""Unicode's categories of control characters, lone surrogates, and separators of lines and paragraphs."""
_DIRECTIONS = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
"""Unicode's directions of characters that reorder the text around them."""
_MAX_LENGTH = 2000
"""Characters of a message; more would fill the screen."""
_MARKUP = re.compile(r"[\\`|<>$]|\](?=\()")
"""Characters that begin an element, a formula or code in Markdown, make a link, or end a table's cell."""


def has_controls(text: str) -> bool:
    """Whether a text has characters that control a terminal, reorder other characters, or are not Unicode."""
    return any(map(_is_control, text))


def printable(text: str) -> str:
    """A message in one line, in which characters that control a terminal are escaped. A long one loses its middle."""
    half = _MAX_LENGTH // 2
    shown = text if len(text) <= _MAX_LENGTH else f"{text[:half]} … {text[-half:]}"
    return "".join(ascii(c)[1:-1] if _is_control(c) else c for c in shown)


def in_markdown(text: str) -> str:
    """Text that Markdown shows as it is, also in a table."""
    return _MARKUP.sub(r"\\\g<0>", text)


def _is_control(character: str) -> bool:
    return unicodedata.category(character) in _CONTROLS or unicodedata.bidirectional(character) in _DIRECTIONS


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
