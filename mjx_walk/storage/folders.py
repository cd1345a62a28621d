"""Folders that are written completely or not at all, and found again if a crash came between two renames."""

import contextlib
import errno
import os
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

from mjx_walk.storage.files import fresh_name, sync, sync_tree

__all__ = ["discard", "find_written", "remove_unfinished", "replacing_folder"]

_UNFINISHED = ".unfinished"
"""Suffix of folders that are being written, replaced or removed."""


@contextlib.contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Context manager for writing a folder under a fresh name. On success it replaces `path`, else it is removed.

    All its files are on the disk before the name is. The folder above `path` is created, but none above that.

    Raises:
        FileNotFoundError: a folder above `path` was moved or removed in the meantime.
    """
    path.parent.mkdir(exist_ok=True)
    unfinished, former = _hidden_name(path), _hidden_name(path)
    unfinished.mkdir()
    places = {folder: _identity(folder) for folder in (unfinished, *path.parents)}
    try:
        yield unfinished
        if _identity(unfinished) != places[unfinished]:  # TensorStore creates missing folders
            raise FileNotFoundError(errno.ENOENT, "a folder above was moved or removed", str(path))
        sync_tree(unfinished)
        if path.exists():
            os.replace(path, former)  # atomic, unlike removing a folder
        os.replace(unfinished, path)
        sync(path.parent)
    except BaseException:
        if former.exists() and not path.exists():
            os.replace(former, path)
        raise
    finally:
        if path.exists():
            _remove(former)
        _remove(unfinished)
        for folder in path.parents:
            if _identity(folder) not in (places[folder], None):  # created again, too
                with contextlib.suppress(OSError):
                    folder.rmdir()  # if it is empty


def _identity(folder: Path) -> tuple[int, int] | None:
    """Identity of a folder, which stays the same when it is moved. None if the system shows none."""
    try:
        status = folder.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def find_written(path: Path, last_file: str) -> Path | None:
    """The folder at `path`. If a crash came before its last rename, the newest complete one that was meant for `path`.

    Args:
        path: as given to `replacing_folder`.
        last_file: name of the file that is written last.
    """
    if path.is_dir():
        return path
    hidden = [folder / last_file for folder in path.parent.glob(f".{path.name}.*{_UNFINISHED}")]
    written = [file for file in hidden if file.is_file()]
    return max(written, key=lambda file: file.stat().st_mtime_ns).parent if written else None


def discard(path: Path) -> None:
    """Remove a folder. A crash leaves it complete, or without its name."""
    hidden = _hidden_name(path)
    os.replace(path, hidden)
    _remove(hidden)


def remove_unfinished(folder: Path, keep: Collection[Path | None] = ()) -> None:
    """Remove what crashes have left in a folder.

    Args:
        folder: where `replacing_folder` and `discard` have been called.
        keep: results of `find_written`.
    """
    for path in folder.glob(f".*{_UNFINISHED}"):
        if path not in keep:
            _remove(path)


def _hidden_name(path: Path) -> Path:
    return fresh_name(path.with_name(path.name + _UNFINISHED))


def _remove(path: Path) -> None:
    """Remove a folder, or a file that stands in its place, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
