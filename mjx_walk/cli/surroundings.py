"""Checks of the system around a command: a working folder, text that can be written, and disks."""

import errno
import os
import re
import sys

from mjx_walk.storage.files import NO_WORKING_FOLDER
from mjx_walk.utils.errors import UserError

__all__ = ["check_surroundings", "correctable"]

_DISK_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO),
    *(errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP),
)


def check_surroundings(arguments: list[str]) -> None:
    """Check what no command works without: a working folder, and text that can be written to files.

    Raises:
        UserError: the working folder was deleted, or has a name that is no text in the locale's encoding, or an
            argument is none.
    """
    try:
        here = os.getcwd()
    except FileNotFoundError:
        raise UserError(NO_WORKING_FOLDER) from None
    encoding = sys.getfilesystemencoding()
    # Python puts a lone surrogate in the place of a byte that it cannot decode.
    for name, text in (("the working folder", here), *(("the argument", argument) for argument in arguments)):
        if re.search("[\ud800-\udfff]", text) and (encoding != "utf-8" or text == here):
            shown = os.fsencode(text).decode("utf-8", errors="backslashreplace")
            advice = "set PYTHONUTF8=1" if encoding != "utf-8" else "change to another folder"
            raise UserError(f"{name} '{shown}' is no text in the encoding of this locale, {encoding}; {advice}")


def correctable(error: OSError) -> str | None:
    """Message for an error from outside this package that the user can correct. None for others."""
    if error.errno in _DISK_ERRORS:
        return str(error)
    if (error.strerror or "").startswith("No usable temporary directory"):
        return "there is no folder for temporary files; set TMPDIR to one that can be written"
    try:
        os.getcwd()
    except FileNotFoundError:
        return NO_WORKING_FOLDER
    return None
