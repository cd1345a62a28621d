"""Files that are written completely or not at all, never through a link, and that survive a loss of power."""

import contextlib
import errno
import os
import pwd
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import has_controls

__all__ = [
    "NO_WORKING_FOLDER",
    "Appender",
    "check_replaceable",
    "fresh_name",
    "is_unfinished",
    "is_writable_folder",
    "open_to_append",
    "open_to_read",
    "read_bytes",
    "refuse_links",
    "replacing",
    "sync",
    "sync_tree",
    "user_folder",
    "user_path",
    "working_folder",
    "write_text",
]

NO_WORKING_FOLDER = "the working folder was deleted; change to another one, for example with cd ~"


def working_folder() -> Path:
    """The working folder.

    Raises:
        UserError: it was deleted.
    """
    try:
        return Path.cwd()
    except FileNotFoundError:
        raise UserError(NO_WORKING_FOLDER) from None


def user_path(path: str | Path) -> Path:
    """A path that a user gives, with a leading `~` expanded. Expanding the result again changes nothing.

    Raises:
        UserError: there is no such home folder, or the path is empty or has a character that controls a terminal.
    """
    text = str(path)
    if has_controls(text):
        raise UserError(f"the path {text!a} has characters that cannot be printed; choose another one")
    if not text:
        raise UserError("a path is empty; write the name of a file or folder")
    if not text.startswith("~"):
        return working_folder() / text if str(Path(text)).startswith("~") else Path(text)
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise UserError(f"'{text}': there is no such home folder; for a folder of this name write ./{text}") from error


def user_folder(variable: str, below_home: str) -> Path | None:
    """A folder of the user for one kind of files, as the XDG Base Directory Specification says.

    Args:
        variable: environment variable that names it, such as `XDG_CACHE_HOME`. A relative path there is ignored.
        below_home: name of the default folder in the user's home.

    Returns:
        The path, or None if the user has no home.
    """
    base = os.environ.get(variable, "")
    if os.path.isabs(base):
        return Path(base)
    home = os.environ.get("HOME", "")
    if not home:
        try:
            home = pwd.getpwuid(os.getuid()).pw_dir
        except KeyError:
            return None
    return Path(home, below_home) if os.path.isabs(home) else None


def is_writable_folder(folder: Path) -> bool:
    """Whether a folder can be written. It is created if it does not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


@contextlib.contextmanager
def replacing(path: Path, mode: int = 0o666) -> Iterator[Path]:
    """Context manager for writing a file under a fresh name in the same folder. On success it replaces `path`.

    The content is on the disk before the name is, so that a loss of power leaves the old file or the new one.
    A symbolic or hard link at `path` is replaced; the file that it leads to stays unchanged. On an error, `path` stays
    as it is, and the new file is removed.

    Args:
        path: of the file.
        mode: permissions of the new file, which the user's umask limits.

    Yields:
        The fresh name, with the suffix of `path`. Its empty file exists.

    Raises:
        UserError: see `check_replaceable`.
        OSError: the folder around it cannot be written to.
    """
    check_replaceable(path)
    new = fresh_name(path)
    os.close(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
    try:
        yield new
        sync(new)
        os.replace(new, path)
        sync(path.parent)
    except BaseException as error:
        new.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(new)):
            error.filename = str(path)  # for messages
        raise


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on the disk.

    A link to a folder is followed. A folder that the user may not list is left to the file system.
    """
    is_folder = path.is_dir()
    try:
        descriptor = os.open(path, os.O_RDONLY if is_folder else os.O_RDONLY | os.O_NOFOLLOW)
    except PermissionError:
        if is_folder:
            return
        raise
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # file systems that cannot sync folders say so
            raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Wait until all files and folders below a folder, and the folder itself, are on the disk."""
    for directory, _, files in os.walk(folder, topdown=False):
        for name in files:
            sync(Path(directory, name))
        sync(Path(directory))


def check_replaceable(path: Path) -> None:
    """Check that a path may be replaced: root could replace /dev/null.

    Raises:
        UserError: a folder, a device or a pipe, or a file that the user may not write.
    """
    if path.exists() and not path.is_file():
        raise UserError(f"cannot write {path}: it is not a regular file; choose another path")
    if path.exists() and not os.access(path, os.W_OK):
        raise UserError(f"cannot write {path}: it is read-only; choose another path, or remove it")


def refuse_links(path: Path, folder: Path) -> None:
    """Check that no part of a path below a folder, which may be downloaded, is a link that leads elsewhere.

    Raises:
        UserError: a part is a symbolic link.
    """
    for part in (path, *path.parents):
        if part == folder:
            return
        if part.is_symlink():
            raise UserError(f"'{part}' is a symbolic link; replace it by what it points to")


def fresh_name(path: Path) -> Path:
    """An unpredictable, hidden name in the same folder, with the same suffix."""
    return path.with_name(f".{path.stem}.{secrets.token_hex(8)}{path.suffix}")


def is_unfinished(path: Path) -> bool:
    """Whether a path is a file under a fresh name, which a crash has left."""
    is_fresh = re.fullmatch(r"\..+\.[0-9a-f]{16}(\.\w+)?", path.name)
    return bool(is_fresh) and path.is_file() and not path.is_symlink()


def write_text(path: Path, text: str, mode: int = 0o666) -> None:
    """Write a UTF-8 file as `replacing` does."""
    with replacing(path, mode) as new:
        new.write_text(text, encoding="utf-8")


def open_to_read(path: Path) -> BinaryIO:
    """Open a file that a stranger may have put there. A pipe or device, which blocks or never ends, is refused.

    Raises:
        OSError: not a regular file, or one that cannot be read.
    """
    return open(path, "rb", opener=_open_regular)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Content of a file that a stranger may have written: no more is read than such a file ever holds.

    Raises:
        ValueError: it is larger.
        OSError: as for `open_to_read`.
    """
    with open_to_read(path) as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise ValueError(f"it is larger than {max_bytes:,} bytes")
    return content


def open_to_append(path: Path) -> int:
    """Open a file to append to it, and create it if it does not exist. Symbolic links, pipes and devices are refused.

    Returns:
        A file descriptor.

    Raises:
        OSError: not a regular file, or one that cannot be written.
    """
    return _open_regular(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW)


def _open_regular(path: str | Path, flags: int) -> int:
    """Open a regular file. Without `O_NONBLOCK`, opening a pipe would wait for its other end."""
    try:
        descriptor = os.open(path, flags | os.O_NONBLOCK, 0o666)
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        raise OSError(errno.EINVAL, "not a regular file", str(path)) from error  # a pipe that nobody reads, or a socket
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "not a regular file", str(path))


class Appender:
    """A file to which bytes are appended without a buffer, so that the end of this process loses none of them."""

    def __init__(self, path: Path):
        """
        Args:
            path: of the file, which is created if it does not exist. A symbolic link is refused.
        """
        self._path = path
        self._descriptor = open_to_append(path)

    def append(self, data: bytes) -> None:
        """Append all bytes.

        Raises:
            OSError: with the path, for example because the disk is full. Some of the bytes may be written.
        """
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from error

    @property
    def is_in_place(self) -> bool:
        """Whether the path still leads to this file: it may have been removed, moved or replaced."""
        try:
            return os.path.samestat(os.stat(self._path), os.fstat(self._descriptor))
        except OSError:
            return False

    def sync(self) -> None:
        """Wait until the content is on the disk."""
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from error

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)
