"""The metadata stored with a checkpoint, checked before they are used: the file may come from anywhere."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict, cast

from mjx_walk.storage.checksums import read_json, take_checksum, with_checksum
from mjx_walk.storage.files import write_text
from mjx_walk.utils.errors import failed_read
from mjx_walk.utils.versions import __version__

__all__ = ["FORMAT", "Metadata", "read_metadata", "write_metadata"]

FORMAT = 1
"""Version of the checkpoint format. Increment it when a change makes older checkpoints unreadable."""

_MAX_BYTES = 2_000_000
_MAX_NUMBER = 1e300
_MAX_SNAPSHOTS = 100
_REQUIRED = ("env_steps", "crc32")


class Metadata(TypedDict, total=False):
    """Facts stored with a checkpoint or a policy, as JSON."""

    format: int
    """`FORMAT` of the version that wrote it."""
    mjx_walk: str
    """That version."""
    env_steps: int
    """Environment steps before it was saved, or, of the best policy, before its evaluation."""
    wall_seconds: float
    """Seconds of training so far."""
    num_devices: int
    """Devices that saved it."""
    seeds_together: int
    """Runs that trained in one program."""
    eval_return: float
    """Mean return of the evaluation that chose the policy."""
    fraction: float
    """Of a milestone: the part of the way from the first evaluation to the best one at which it is."""
    snapshots: list[int]
    """Environment steps of the snapshots of policies that a checkpoint holds."""
    log_rows: int
    """Rows of `metrics.jsonl` so far."""
    log_crc32: int
    """Their checksum."""
    config_crc32: int
    """Checksum of the copy of the configuration."""
    crc32: dict[str, int]
    """Checksums of the arrays, by path."""


def write_metadata(path: Path, metadata: Metadata) -> None:
    """Write a `meta.json`, with the versions and a checksum."""
    content: dict[str, object] = {"format": FORMAT, "mjx_walk": __version__, **metadata}
    write_text(path, json.dumps(with_checksum(content)))


def read_metadata(path: Path) -> Metadata:
    """Read a `meta.json`. Facts that this version does not know are not checked.

    Returns:
        The metadata. Those of another format than `FORMAT` are returned without a look at the checksum.

    Raises:
        UnreadableError: the file cannot be read now.
        ValueError: the file is missing, a fact is not what it should be, or the checksum does not match.
    """
    try:
        metadata = read_json(path, _MAX_BYTES)
    except OSError as error:
        raise failed_read(path.parent, error) from error
    except ValueError as error:
        raise ValueError(f"{path.parent} is damaged: {path.name}: {error}") from error
    for name, (is_valid, valid) in _FACTS.items():
        if name in metadata and not is_valid(metadata[name]):
            raise ValueError(f"{path}: {name} should be {valid}, found {_shown(metadata[name])}")
        if name in _REQUIRED and name not in metadata:
            raise ValueError(f"{path}: {name} should be {valid}, found nothing")
    if not take_checksum(metadata) and metadata.get("format") == FORMAT:
        raise ValueError(f"{path.parent} is damaged: {path.name} does not match its checksum")
    return cast(Metadata, metadata)


def _is_count(value: object, at_least: int = 0) -> bool:
    return type(value) is int and at_least <= value < 2**63


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < _MAX_NUMBER


def _are_few_counts(value: object) -> bool:
    return isinstance(value, list) and len(value) <= _MAX_SNAPSHOTS and all(map(_is_count, value))


_FACTS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "env_steps": (_is_count, "a whole number from 0"),
    "wall_seconds": (lambda value: _is_finite(value) and value >= 0, "a number from 0"),
    "num_devices": (lambda value: _is_count(value, 1) and value <= 10**6, "a whole number from 1 to 1,000,000"),
    "eval_return": (_is_finite, "a finite number"),
    "fraction": (_is_finite, "a finite number"),
    "snapshots": (_are_few_counts, "a short list of whole numbers from 0"),
    "seeds_together": (lambda value: _is_count(value, 1), "a whole number from 1"),
    "log_rows": (_is_count, "a whole number from 0"),
    "log_crc32": (_is_count, "a whole number from 0"),
    "config_crc32": (_is_count, "a whole number from 0"),
    "format": (_is_count, "a whole number from 0"),
    "mjx_walk": (lambda value: isinstance(value, str) and value.isprintable() and len(value) < 100, "a version"),
    "crc32": (lambda value: isinstance(value, dict) and all(map(_is_count, value.values())), "whole numbers by name"),
}
"""Facts of a checkpoint: whether a value is valid, and what is."""


def _shown(value: object) -> str:
    """The start of a value, in one line."""
    if isinstance(value, int) and not _is_count(abs(value)):
        return "a huge number"  # Python refuses to print it
    return ascii(value)[:60] if isinstance(value, str | int | float | None) else f"a JSON {type(value).__name__}"
