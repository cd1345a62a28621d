"""Checksums of bytes, arrays and JSON objects, which reveal a change. Files may come from an untrusted source."""

import json
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_walk.storage.files import read_bytes

__all__ = ["check_arrays", "crc32", "read_json", "take_checksum", "with_checksum"]

_KEY = "checksum"
_MAX_DEPTH = 20
"""Deepest nesting that is read. Python's JSON encoder supports far less nesting than its decoder."""


def crc32(data: bytes | np.ndarray, before: int = 0) -> int:
    """Checksum of bytes or of an array's elements.

    Args:
        data: bytes, or an array of any dtype.
        before: checksum of the data before these.
    """
    return zlib.crc32(data if isinstance(data, bytes) else np.ascontiguousarray(data).view(np.uint8).data, before)


def check_arrays(names: Iterable[str], arrays: Mapping[str, np.ndarray], checksums: Mapping[str, int]) -> None:
    """Check that arrays are those that were saved. A name that was not saved is not checked.

    Args:
        names: names of the arrays to check.
        arrays: the arrays that were read, by name.
        checksums: checksums of all arrays that were saved, by name.

    Raises:
        ValueError: an array has no checksum, has another one, or was not read.
    """
    for name in names:
        if name in arrays and name not in checksums:
            raise ValueError(f"{name} has no checksum")
        if name in checksums and (name not in arrays or crc32(arrays[name]) != checksums[name]):
            raise ValueError(f"{name} does not match its checksum")


def read_json(path: Path, max_bytes: int) -> dict[str, Any]:
    """Content of a JSON file that holds an object.

    Raises:
        ValueError: it is too large, nested too deeply, not JSON in UTF-8, or not an object.
        OSError: it is not a regular file, or cannot be read.
    """
    try:
        content = json.loads(read_bytes(path, max_bytes).decode())
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not _is_shallow(content, _MAX_DEPTH):
        raise ValueError("it is nested too deeply")
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
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
    return crc32(json.dumps(content, sort_keys=True).encode())


def _is_shallow(value: object, depth: int) -> bool:
    if not isinstance(value, dict | list):
        return True
    parts = value.values() if isinstance(value, dict) else value
    return depth > 0 and all(_is_shallow(part, depth - 1) for part in parts)
