"""Save and restore a whole TrainState with Orbax: atomic, checked leaf by leaf, the newest few kept."""

import json
import os
import shutil
import warnings
import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

import mjx_walk
from mjx_walk.errors import UserError

FORMAT = 1
"""Raised when older checkpoints can no longer be read."""

_META = "meta.json"
_ARRAYS = "arrays"


def save(path: Path, tree: Any, meta: dict[str, Any]) -> None:
    """Write a pytree of arrays. The folder appears under its name only when it is complete.

    Args:
        path: folder to make; one that is there is replaced.
        tree: arrays of any dtype.
        meta: JSON-able facts to keep beside it; version and checksums are added.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree).items()}
    meta = meta | {
        "format": FORMAT,
        "mjx_walk": mjx_walk.__version__,
        "crc32": {name: _crc32(x) for name, x in arrays.items()},
    }
    unfinished = path.with_name(f".{path.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    with ocp.PyTreeCheckpointer() as checkpointer:
        checkpointer.save(unfinished.absolute() / _ARRAYS, arrays)
    (unfinished / _META).write_text(json.dumps(meta))
    shutil.rmtree(path, ignore_errors=True)
    os.replace(unfinished, path)


def restore(path: Path, like: Any) -> tuple[Any, dict[str, Any]]:
    """Read what `save` wrote.

    Args:
        path: its folder.
        like: a pytree of arrays or `ShapeDtypeStruct`s of the same structure.

    Returns:
        The tree, on the default device, and the facts beside it.

    Raises:
        UserError: made by an incompatible version, or for a TrainState of another shape.
        ValueError: the folder is damaged.
    """
    meta = read_meta(path)
    if meta.get("format") != FORMAT:
        raise UserError(
            f"{path} was written by mjx_walk {meta.get('mjx_walk')} in checkpoint format {meta.get('format')}; "
            f"this is {mjx_walk.__version__} with format {FORMAT}"
        )
    wanted = _named_leaves(like)
    try:
        with ocp.PyTreeCheckpointer() as checkpointer:
            arrays = checkpointer.restore(path.absolute() / _ARRAYS)
    except Exception as error:  # Orbax reports damage through many types
        raise ValueError(f"{path} is damaged: {str(error).splitlines()[0][:200]}") from error
    for name, crc in meta["crc32"].items():
        if name not in arrays or _crc32(arrays[name]) != crc:
            raise ValueError(f"{path} is damaged: {name} does not match its checksum")
    for name, leaf in wanted.items():
        if name not in arrays or arrays[name].shape != leaf.shape or arrays[name].dtype != leaf.dtype:
            found = f"{arrays[name].shape} {arrays[name].dtype}" if name in arrays else "nothing"
            raise UserError(f"{path} is of another run: {name} should be {leaf.shape} {leaf.dtype}, found {found}")
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), meta


def read_meta(path: Path) -> dict[str, Any]:
    """The facts beside a checkpoint.

    Raises:
        ValueError: the folder is damaged.
    """
    try:
        return json.loads((path / _META).read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def list_steps(folder: Path) -> list[Path]:
    """Checkpoints of a run, oldest first. Their names are zero-padded environment steps."""
    return sorted(path for path in folder.glob("[0-9]*") if path.is_dir())


def step_path(folder: Path, env_steps: int) -> Path:
    """Where the checkpoint of a number of environment steps lies."""
    return folder / f"{env_steps:013d}"


def restore_newest(folder: Path, like: Any) -> tuple[Any, dict[str, Any]]:
    """The newest checkpoint that is whole; a damaged one is passed over with a warning.

    Raises:
        UserError: there is none, or it belongs to another run.
    """
    for path in reversed(list_steps(folder)):
        try:
            return restore(path, like)
        except UserError:
            raise
        except ValueError as error:
            warnings.warn(f"{error}; falling back to the checkpoint before it", stacklevel=2)
    raise UserError(f"no usable checkpoint in {folder}; nothing to resume")


def prune(folder: Path, keep: int) -> None:
    """Remove all but the newest `keep` checkpoints, and what an interrupted save left."""
    for path in list_steps(folder)[:-keep]:
        shutil.rmtree(path)
    for path in folder.glob(".*.unfinished"):
        shutil.rmtree(path)


def _crc32(array: np.ndarray) -> int:
    return zlib.crc32(array.tobytes())


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
