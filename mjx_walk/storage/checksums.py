"""JSON objects with a checksum, which reveals a change of the file. The file may come from an untrusted source."""

import json
import zlib
from pathlib import Path

from mjx_walk.storage.files import read_bytes

__all__ = ["read_json", "take_checksum", "with_checksum"]

_KEY = "checksum"
_MAX_DEPTH = 20
"""Deepest nesting that is read. Python's JSON encoder supports far less nesting than its decoder."""


def read_json(path: Path, max_bytes: int) -> object:
    """Content of a JSON file.

    Raises:
        ValueError: it is too large, nested too deeply, or not JSON in UTF-8.
        OSError: it is not a regular file, or cannot be read.
    """
    try:
        content = json.loads(read_bytes(path, max_bytes).decode())
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not _is_shallow(content, _MAX_DEPTH):
        raise ValueError("it is nested too deeply")
    return content


def with_checksum(content: dict[str, object]) -> dict[str, object]:
    """A JSON object with a checksum of all its other members."""
    return content | {_KEY: _checksum(content)}


def take_checksum(content: dict[str, object]) -> bool:
    """Remove the checksum of a JSON object.

    Returns:
        Whether it matches. An object of an earlier version has none, and counts as matching.
    """
    found = content.pop(_KEY, None)
    return found is None or found == _checksum(content)


def _checksum(content: dict[str, object]) -> int:
    return zlib.crc32(json.dumps(content, sort_keys=True).encode())


def _is_shallow(value: object, depth: int) -> bool:
    if not isinstance(value, dict | list):
        return True
    parts = value.values() if isinstance(value, dict) else value
    return depth > 0 and all(_is_shallow(part, depth - 1) for part in parts)
