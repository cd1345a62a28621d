"""The user's own list of reward functions and tasks that may run without being named again.

It stands outside any run folder: a downloaded folder cannot bring its own entries.
"""

import json
import logging
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TypeGuard

from mjx_walk.envs.user_files import changed_file, only_known, source_path
from mjx_walk.storage.files import user_folder, write_text
from mjx_walk.utils.errors import UserError

__all__ = ["Trusted", "are_hashes", "remember", "require_trusted", "trust_file"]

_LOGGER = logging.getLogger(__name__)

Trusted = dict[str, dict[str, str]]
"""For each `PATH.py:NAME`, the SHA-256 of the file and of its helpers, by absolute path."""


def trust_file() -> Path | None:
    """Path of the list: `mjx_walk/trusted_reward_functions.json` in `$XDG_CONFIG_HOME`, by default `~/.config`.

    None if the user has no home folder.
    """
    folder = user_folder("XDG_CONFIG_HOME", ".config")
    return folder / "mjx_walk" / "trusted_reward_functions.json" if folder else None


def remember(source: str, hashes: Mapping[str, str], key: str = "env.reward_function") -> None:
    """Note a reward function or task that the user has named. A list that cannot be read or written only warns.

    Args:
        source: absolute `PATH.py:NAME`.
        hashes: SHA-256 of the file and of its helpers, by absolute path.
        key: the setting that names it, for messages.
    """
    trusted = _read()
    if trusted is None or trusted.get(source) == hashes:
        return
    path = trust_file()
    if path is None:
        _LOGGER.warning("no home folder: set HOME or XDG_CONFIG_HOME, or a resume needs %s", _named(key, source))
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_text(path, json.dumps(trusted | {source: dict(hashes)}, indent=1), mode=0o600)
    except (OSError, UserError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        _LOGGER.warning("%s cannot be written (%s); a resume needs %s", path, reason, _named(key, source))


def require_trusted(source: str, key: str = "env.reward_function") -> None:
    """Check that the user has named a reward function or task before, and that its files are the same.

    This process then runs only these files for it.

    Args:
        source: `PATH.py:NAME` of a saved configuration.
        key: the setting that names it, for messages.

    Raises:
        UserError: the user has not named it, or a file has changed; the message says what to type.
    """
    hashes = (_read() or {}).get(source)
    if hashes is None or not os.path.isabs(source):
        raise UserError(f"the saved run uses the code of {source}; to run it, add {_named(key, source)}")
    changed = changed_file(hashes)
    if changed:
        raise UserError(f"{changed} has changed since you named it; to run it as it is now, add {_named(key, source)}")
    only_known(source_path(source), hashes)


def _named(key: str, source: str) -> str:
    return shlex.quote(f"{key}={source}")


def _read() -> Trusted | None:
    """The list. None, and a warning, if there is a file that is not such a list."""
    path = trust_file()
    if path is None:
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except OSError as error:
        content, reason = None, error.strerror
    except (ValueError, RecursionError) as error:
        content, reason = None, str(error)
    else:
        reason = "it is not a list of reward functions"
    if are_hashes(content):
        return content
    _LOGGER.warning("%s is ignored (%s); remove it, or name the file each time", path, reason)
    return None


def are_hashes(content: object) -> TypeGuard[Trusted]:
    """Whether a JSON value is a dictionary of dictionaries of texts, as the list and the record of a run folder are."""
    groups = list(content.values()) if isinstance(content, dict) else [content]
    return all(isinstance(group, dict) and all(isinstance(found, str) for found in group.values()) for group in groups)
