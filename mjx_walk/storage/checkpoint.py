"""Save and restore a complete TrainState in Orbax's format, atomically and with checksums.

Orbax's CheckpointManager treats all parts of a step alike and synchronizes all processes at each save. Here, only the
newest step keeps its replay buffer, and each process writes its own folder.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.storage.arrays import HostArrays, read_arrays, write_arrays
from mjx_walk.storage.checkpoint_metadata import FORMAT, Metadata, read_metadata, write_metadata
from mjx_walk.storage.checksums import check_arrays, crc32
from mjx_walk.storage.files import read_bytes, write_text
from mjx_walk.storage.folders import discard, find_written, remove_unfinished, replacing_folder
from mjx_walk.storage.saved_yaml import MAX_BYTES
from mjx_walk.storage.scores import POLICIES
from mjx_walk.utils.errors import UnreadableError, UserError, failed_read
from mjx_walk.utils.versions import __version__

__all__ = [
    "SNAPSHOTS",
    "config_copy",
    "discard_from",
    "find",
    "list_steps",
    "present_name",
    "prune",
    "read_meta",
    "restore",
    "restore_newest",
    "save",
    "step_path",
    "to_host",
]

_Tree = TypeVar("_Tree")

_META = "meta.json"
"""File that is written last."""
_ARRAYS = "arrays"
_CONFIG = "run_config.yaml"
"""Copy of the run's configuration. Earlier versions wrote none."""
_CONFIG_CHECKSUM: Final = "config_crc32"
_REPLAY = "replay"
"""Field of the TrainState that only the newest checkpoint keeps, and the name of its folder."""
SNAPSHOTS = "snapshots"
"""Start of the names of policies that a checkpoint holds besides the TrainState, and the name of their folder."""

_RENAMED_LEAVES = {
    "updates": "iterations",
    "env.is_whole": "env.started_at_reset",
    "env.live.snapshot_update": "evaluation.snapshot_iteration",
    "env.live.best_update": "evaluation.best_iteration",
    "env.live": "evaluation",
    "noise": "exploration",
}
"""Present paths of leaves, by the former paths in older checkpoints."""


def to_host(tree: object) -> HostArrays:
    """Copy a pytree to the host. The next program may then reuse its device memory."""
    return {name: np.array(leaf) for name, leaf in _named_leaves(jax.device_get(tree)).items()}


def save(path: Path, tree: object, meta: Metadata, as_numpy: bool = False, config: str | None = None) -> None:
    """Write a pytree of arrays. The folder gets its name only when it is complete.

    Args:
        path: folder to write; an existing one is replaced.
        tree: arrays of any dtype, or the result of `to_host`.
        meta: JSON-serializable metadata to store with the arrays; version and checksums are added.
        as_numpy: write one compressed NumPy file instead of Orbax's folder.
        config: text of the configuration, of which the folder gets a copy.

    Raises:
        OSError: writing failed, for example because the disk is full.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree).items()}
    meta = meta | {"crc32": {name: crc32(x) for name, x in arrays.items()}}
    with replacing_folder(path) as unfinished:
        for folder in (_ARRAYS, *sorted({_folder_of(name) for name in arrays} - {_ARRAYS})):
            own = {name: x for name, x in arrays.items() if _folder_of(name) == folder}
            write_arrays(unfinished / folder, own, as_numpy)
        if config is not None:
            write_text(unfinished / _CONFIG, config)
            meta[_CONFIG_CHECKSUM] = crc32(config.encode())
        write_metadata(unfinished / _META, meta)


def find(path: Path) -> Path | None:
    """The folder that was saved at `path`, also if a crash has left it without its name. None if there is none."""
    return find_written(path, _META)


def config_copy(path: Path) -> Path | None:
    """The copy of the configuration that a checkpoint holds; None in checkpoints of earlier versions.

    Raises:
        ValueError: the copy or the metadata are damaged.
    """
    checksum = read_meta(path).get(_CONFIG_CHECKSUM)
    if checksum is None:
        return None
    copy = path / _CONFIG
    try:
        is_damaged = crc32(read_bytes(copy, MAX_BYTES)) != checksum
    except OSError as error:
        raise failed_read(path, error) from error
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {copy.name}: {error}") from error
    if is_damaged:
        raise ValueError(f"{path} is damaged: {copy.name} does not match its checksum")
    return copy


def restore(path: Path, like: _Tree) -> tuple[_Tree, Metadata]:
    """Read a checkpoint that `save` wrote.

    Args:
        path: folder of the checkpoint.
        like: pytree of arrays or `ShapeDtypeStruct`s with the same structure.

    Returns:
        The tree, on the default device, and its metadata. If `prune` has removed the replay buffer, the tree has an
        empty one, and a warning says so.

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
    config_copy(path)
    wanted = _named_leaves(like)
    meta["crc32"] = {present_name(name): crc for name, crc in meta["crc32"].items()}
    arrays: HostArrays = {}
    for folder in sorted({_folder_of(name) for name in wanted} - {_REPLAY}):
        arrays |= read_arrays(path / folder, wanted, present_name)
    if any(_is_replay(name) for name in meta["crc32"]) and any(map(_is_replay, wanted)):
        if (path / _REPLAY).exists():
            arrays |= read_arrays(path / _REPLAY, wanted, present_name)
        else:
            warnings.warn(f"{path} has no replay buffer; training refills it before learning continues", stacklevel=2)
            empty = {name: np.zeros(leaf.shape, leaf.dtype) for name, leaf in wanted.items() if _is_replay(name)}
            arrays |= empty
            meta["crc32"] |= {name: crc32(array) for name, array in empty.items()}
    try:
        check_arrays(wanted, arrays, meta["crc32"])
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    for name, leaf in wanted.items():
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


def read_meta(path: Path) -> Metadata:
    """Facts stored with a checkpoint.

    Raises:
        ValueError: the folder is damaged, or a fact is not what it should be.
    """
    return read_metadata(path / _META)


def list_steps(folder: Path) -> list[Path]:
    """Checkpoints of a run, oldest first. Their names are environment steps of thirteen digits."""
    return sorted(path for path in folder.glob("[0-9]" * 13) if path.is_dir() and not path.is_symlink())


def step_path(folder: Path, env_steps: int) -> Path:
    """Path of the checkpoint at a number of environment steps."""
    return folder / f"{env_steps:013d}"


def restore_newest(
    folder: Path,
    like: _Tree,
    part: Callable[[Path], Path] = lambda path: path,
    agree: Callable[[bool], bool] = lambda is_complete: is_complete,
    at_most: int | None = None,
) -> tuple[_Tree, Metadata]:
    """Restore the newest complete checkpoint. Skips those that cannot be read, with a warning.

    Args:
        folder: folder of the checkpoints.
        like: as for `restore`.
        part: maps a checkpoint's path to the path to read. Raises ValueError if the checkpoint is damaged.
        agree: maps whether the part is complete to whether to use the checkpoint. Called once per checkpoint.
        at_most: environment steps that the checkpoint may have at most.

    Raises:
        UserError: there is no usable checkpoint, one cannot be read now, or the newest belongs to another run and no
            other one is usable.
    """
    problems: list[ValueError] = []
    paths = [path for path in list_steps(folder) if at_most is None or int(path.name) <= at_most]
    for path in reversed(paths):
        found = None
        try:
            found = restore(part(path), like)
            _check_steps(path, found[1])
        except UnreadableError:
            raise  # an older checkpoint would lose steps that are still there
        except MemoryError as error:
            raise UserError(f"not enough memory to read {path}; free some, then resume") from error
        except ValueError as error:
            found = None
            problems.append(error)
        if agree(found is not None) and found:
            for problem in problems:
                warnings.warn(f"{problem}; falling back to the previous checkpoint", stacklevel=2)
            return found
    if problems and isinstance(problems[0], UserError):
        raise problems[0]
    for problem in problems:
        warnings.warn(str(problem), stacklevel=2)
    raise UserError(f"no usable checkpoint in {folder}; restore it from a backup, or train again in another folder")


def _check_steps(path: Path, meta: Metadata) -> None:
    """Check that a checkpoint is the one that its name says. Facts of earlier versions have no checksum."""
    if meta["env_steps"] != int(path.name):
        raise ValueError(f"{path} is damaged: its metadata are of step {meta['env_steps']}")


def discard_from(folder: Path, env_steps: int) -> None:
    """Remove the checkpoints from a step on: the run has resumed from before them."""
    for path in list_steps(folder):
        if int(path.name) >= env_steps:
            discard(path)


def prune(folder: Path, max_to_keep: int) -> None:
    """Remove old checkpoints, old replay buffers and unfinished saves.

    Args:
        folder: folder of the checkpoints.
        max_to_keep: number of newest checkpoints to keep. Only the newest keeps its replay buffer.
    """
    for path in list_steps(folder)[:-max_to_keep]:
        discard(path)
    for path in list_steps(folder)[:-1]:
        if (path / _REPLAY).exists():
            discard(path / _REPLAY)
        remove_unfinished(path)
    remove_unfinished(folder, keep=[find(folder / name) for name in POLICIES])


def _is_replay(name: str) -> bool:
    return _folder_of(name) == _REPLAY


def _folder_of(leaf: str) -> str:
    """Name of the folder, in that of the checkpoint, that holds a leaf."""
    first = leaf.partition(".")[0]
    return first if first in (_REPLAY, SNAPSHOTS) else _ARRAYS


def _named_leaves(tree: object) -> dict[str, jax.Array]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
