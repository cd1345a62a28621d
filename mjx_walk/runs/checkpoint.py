"""Save and restore a complete TrainState with Orbax, atomically and with a checksum for each leaf.

Orbax's CheckpointManager treats all parts of a step alike and synchronizes all processes at each save. Here, only the
newest step keeps its replay buffer, and each process writes its own folder.
"""

import contextlib
import json
import os
import shutil
import warnings
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.runs.arrays import HostArrays, read_arrays, write_arrays
from mjx_walk.runs.facts import read_facts
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.files import fresh_name, write_text
from mjx_walk.utils.versions import __version__

FORMAT = 1
"""Version of the checkpoint format. Increment it when a change makes older checkpoints unreadable."""

_META = "meta.json"
_ARRAYS = "arrays"
_UNFINISHED = ".unfinished"
"""Suffix of folders that a save has not completed, or has replaced."""
_REPLAY = "replay"
"""Field of the TrainState that only the newest checkpoint keeps, and the name of its folder."""

_RENAMED_LEAVES = {
    "updates": "iterations",
    "env.is_whole": "env.started_at_reset",
    "env.live.snapshot_update": "evaluation.snapshot_iteration",
    "env.live.best_update": "evaluation.best_iteration",
    "env.live": "evaluation",
    "noise": "exploration",
}
"""Present paths of leaves, by the former paths in older checkpoints."""


def to_host(tree: Any) -> HostArrays:
    """Copy a pytree to the host. The next program may then reuse its device memory."""
    return {name: np.array(leaf) for name, leaf in _named_leaves(jax.device_get(tree)).items()}


def save(path: Path, tree: Any, meta: dict[str, Any], as_numpy: bool = False) -> None:
    """Write a pytree of arrays. The folder gets its name only when it is complete.

    Args:
        path: folder to write; an existing one is replaced.
        tree: arrays of any dtype, or the result of `to_host`.
        meta: JSON-serializable facts to store with the arrays; version and checksums are added.
        as_numpy: write one compressed NumPy file instead of Orbax's folder.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree).items()}
    meta = meta | {
        "format": FORMAT,
        "mjx_walk": __version__,
        "crc32": {name: _crc32(x) for name, x in arrays.items()},
    }
    replay = {name: x for name, x in arrays.items() if _is_replay(name)}
    with _replacing_folder(path) as unfinished:
        rest = {name: x for name, x in arrays.items() if name not in replay}
        write_arrays(unfinished / _ARRAYS, rest, as_numpy)
        if replay:
            write_arrays(unfinished / _REPLAY, replay, as_numpy)
        write_text(unfinished / _META, json.dumps(meta))


def restore(path: Path, like: Any) -> tuple[Any, dict[str, Any]]:
    """Read a checkpoint that `save` wrote.

    Args:
        path: folder of the checkpoint.
        like: pytree of arrays or `ShapeDtypeStruct`s with the same structure.

    Returns:
        The tree, on the default device, and its facts. If `prune` has removed the replay buffer, the tree has an empty
        one, and a warning says so.

    Raises:
        UserError: an incompatible version wrote the checkpoint, or its leaves have other shapes.
        ValueError: the folder is damaged.
    """
    meta = read_meta(path)
    if meta.get("format") != FORMAT:
        raise UserError(
            f"{path} has checkpoint format {meta.get('format')}, written by mjx_walk {meta.get('mjx_walk')}; "
            f"mjx_walk {__version__} reads format {FORMAT}; install the version that wrote it, or train again"
        )
    wanted = _named_leaves(like)
    meta["crc32"] = {present_name(name): crc for name, crc in meta["crc32"].items()}
    arrays = read_arrays(path / _ARRAYS, wanted, present_name)
    if any(_is_replay(name) for name in meta["crc32"]):
        if (path / _REPLAY).exists():
            arrays |= read_arrays(path / _REPLAY, wanted, present_name)
        else:
            warnings.warn(f"{path} has no replay buffer; training refills it before learning continues", stacklevel=2)
            arrays |= {name: np.zeros(leaf.shape, leaf.dtype) for name, leaf in wanted.items() if _is_replay(name)}
            meta["crc32"] = {name: crc for name, crc in meta["crc32"].items() if not _is_replay(name)}
    for name, leaf in wanted.items():
        if name in meta["crc32"] and (name not in arrays or _crc32(arrays[name]) != meta["crc32"][name]):
            raise ValueError(f"{path} is damaged: {name} does not match its checksum")
        if name not in arrays:
            raise UserError(
                f"{path} belongs to another run or version: {name} should be {leaf.shape} {leaf.dtype}, found nothing"
            )
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), meta


def present_name(leaf: str) -> str:
    """Present path of a leaf, which may have a former path."""
    for old, new in _RENAMED_LEAVES.items():
        if leaf == old or leaf.startswith(f"{old}."):
            return new + leaf[len(old) :]
    return leaf


def read_meta(path: Path) -> dict[str, Any]:
    """Facts stored with a checkpoint.

    Raises:
        ValueError: the folder is damaged, or a fact is not what it should be.
    """
    return read_facts(path / _META)


def list_steps(folder: Path) -> list[Path]:
    """Checkpoints of a run, oldest first. Their names are environment steps of thirteen digits."""
    return sorted(path for path in folder.glob("[0-9]" * 13) if path.is_dir() and not path.is_symlink())


def step_path(folder: Path, env_steps: int) -> Path:
    """Path of the checkpoint at a number of environment steps."""
    return folder / f"{env_steps:013d}"


def restore_newest(
    folder: Path,
    like: Any,
    part: Callable[[Path], Path] = lambda path: path,
    agree: Callable[[bool], bool] = lambda is_complete: is_complete,
) -> tuple[Any, dict[str, Any]]:
    """Restore the newest complete checkpoint. Skips damaged ones with a warning.

    Args:
        folder: folder of the checkpoints.
        like: as for `restore`.
        part: maps a checkpoint's path to the path to read. Raises ValueError if the checkpoint is damaged.
        agree: maps whether the part is complete to whether to use the checkpoint. Called once per checkpoint.

    Raises:
        UserError: there is no usable checkpoint, or it belongs to another run.
    """
    for path in reversed(list_steps(folder)):
        found = None
        try:
            found = restore(part(path), like)
        except UserError:
            raise
        except ValueError as error:
            warnings.warn(f"{error}; falling back to the previous checkpoint", stacklevel=2)
        if agree(found is not None) and found:
            return found
    raise UserError(f"no usable checkpoint in {folder}; start a new run without resume=true")


def prune(folder: Path, keep: int, newest: str | None = None) -> None:
    """Remove old checkpoints, old replay buffers and unfinished saves.

    Args:
        folder: folder of the checkpoints.
        keep: number of newest checkpoints to keep. Only the newest keeps its replay buffer.
        newest: name of the checkpoint just saved. Later ones are removed: the run has resumed from before them.
    """
    for path in list_steps(folder):
        if newest and path.name > newest:
            shutil.rmtree(path)
    for path in list_steps(folder)[:-keep]:
        shutil.rmtree(path)
    for path in list_steps(folder)[:-1]:
        shutil.rmtree(path / _REPLAY, ignore_errors=True)
    for path in folder.glob(f".*{_UNFINISHED}"):
        _remove(path)


class BackgroundSaver:
    """Writes checkpoints in the background, one at a time. Training waits only for the copy to the host."""

    def __init__(self, folder: Path, keep: int):
        """
        Args:
            folder: folder of the checkpoints.
            keep: number of newest checkpoints to keep.
        """
        self._folder = folder
        self._keep = keep
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._running: Future[None] | None = None

    def save(self, *parts: tuple[Path, Any, dict[str, Any]]) -> None:
        """Copy pytrees to the host and start to write them in order. Waits for the previous save first.

        Args:
            parts: arguments of `checkpoint.save` for each pytree.
        """
        self.wait()
        copied = [(path, to_host(tree), meta) for path, tree, meta in parts]
        self._running = self._executor.submit(self._save, copied)

    def wait(self) -> None:
        """Wait until the current save is complete.

        Raises:
            OSError: writing failed, for example because the disk is full.
        """
        if self._running:
            self._running.result()
            self._running = None

    def _save(self, parts: list[tuple[Path, HostArrays, dict[str, Any]]]) -> None:
        for path, arrays, meta in parts:
            save(path, arrays, meta)
        prune(self._folder, self._keep, max((path.name for path, *_ in parts if path.name.isdigit()), default=None))


@contextlib.contextmanager
def _replacing_folder(path: Path) -> Iterator[Path]:
    """Context manager for writing a folder under a fresh name. On success it replaces `path`, else it is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished, former = (fresh_name(path.with_suffix(_UNFINISHED)) for _ in range(2))
    unfinished.mkdir()
    try:
        yield unfinished
        if path.exists():
            os.replace(path, former)  # atomic, unlike removing a folder
        os.replace(unfinished, path)
    except BaseException:
        if former.exists():
            os.replace(former, path)
        raise
    finally:
        _remove(former)
        _remove(unfinished)


def _remove(path: Path) -> None:
    """Remove a folder, or a file that stands in its place, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _is_replay(name: str) -> bool:
    return name.startswith(f"{_REPLAY}.")


def _crc32(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data)


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
