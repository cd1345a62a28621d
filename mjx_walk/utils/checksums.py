"""Checksums of JSON objects, so that a changed digit is noticed."""

import json
import zlib
from typing import Any

__all__ = ["take_checksum", "with_checksum"]

_KEY = "checksum"


def with_checksum(content: dict[str, Any]) -> dict[str, Any]:
    """A JSON object with a checksum of all its other members."""
    return content | {_KEY: _checksum(content)}


def take_checksum(content: dict[str, Any]) -> bool:
    """Remove the checksum of a JSON object.

    Returns:
        Whether it matches. An object of an earlier version has none, and counts as matching.
    """
    found = content.pop(_KEY, None)
    return found is None or found == _checksum(content)


def _checksum(content: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(content, sort_keys=True).encode())
