"""Suggestions for a name that does not exist."""

import difflib
import re
from collections.abc import Collection

__all__ = ["near_misses", "unknown"]


def near_misses(given: str, known: Collection[str], most: int = 3, cutoff: float = 0.7) -> list[str]:
    """The known names most similar to a given one, if any, regardless of case, separators and a version `-v5`.

    Args:
        given: the name.
        known: valid names.
        most: of them that are returned.
        cutoff: least similarity, from 0 to 1.
    """
    plain = {_plain(name): name for name in known}
    wanted = _plain(given)
    if wanted in plain:
        return [plain[wanted]]
    return [plain[name] for name in difflib.get_close_matches(wanted, plain, most, cutoff)]


def unknown(what: str, given: str, known: Collection[str]) -> str:
    """The error for an unknown name: the similar names, or without any all valid ones.

    Args:
        what: what it should name.
        given: the name.
        known: valid names.
    """
    near = near_misses(given, known)
    hint = f"did you mean: {', '.join(near)}?" if near else f"choose one of: {', '.join(known)}"
    return f"unknown {what} '{given}'; {hint}"


def _plain(name: str) -> str:
    without_version = re.sub(r"-v\d+$", "", name.lower().removeprefix("mjx_walk/"))
    return re.sub(r"[^a-z0-9]", "", without_version)
