"""MuJoCo's warnings, and the file that it writes them to. This module does not import JAX."""

import contextlib
import warnings
from collections.abc import Iterator

import mujoco

__all__ = ["hide_deprecations", "write_no_log"]


def write_no_log() -> None:
    """Stop MuJoCo from appending its warnings to `MUJOCO_LOG.TXT` in the working directory.

    It would follow a link of that name, which a stranger may have put there. It still prints the warnings.
    """
    config = mujoco.MjLogConfig.get()
    config.logto_file = False
    config.set()


@contextlib.contextmanager
def hide_deprecations() -> Iterator[None]:
    """Hide MuJoCo's deprecation warnings, and turn its other warnings into Python's.

    MuJoCo prints each warning to stderr, and `MjSpec` turns those of its compiler into Python's. Every load of
    Gymnasium's HalfCheetah warns of a deprecated attribute, which users cannot change.
    """
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_warn)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "(?s).*is deprecated", UserWarning)
            yield
    finally:
        mujoco.set_mju_user_warning(previous)


def _warn(message: str) -> None:
    warnings.warn(message, stacklevel=2)
