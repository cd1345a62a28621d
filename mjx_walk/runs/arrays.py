"""Folders of named arrays, as Orbax checkpoints or NumPy archives.

A reader trusts no file: before it reads an array, it compares the declared shape and type with the expected ones.
"""

import contextlib
import errno
import logging
import math
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
import tensorstore

from mjx_walk.utils.errors import UserError

__all__ = ["HostArrays", "read_arrays", "write_arrays"]

_NUMPY = "arrays.npz"
"""File that replaces Orbax's files for small pytrees, in processes other than the main one, and below folders in which
Orbax does not find its files."""
_SEPARATOR = "\\"
"""TensorStore takes it for a separator of folders on every system."""
_NOT_FOR_ORBAX = frozenset("*?[" + _SEPARATOR)
"""Characters of a path with which Orbax does not find its own files. It takes the first three for a pattern."""

HostArrays = dict[str, np.ndarray]
"""Host copies of a pytree's leaves, by path."""


def write_arrays(path: Path, arrays: HostArrays, as_numpy: bool = False) -> None:
    """Write a new folder of arrays.

    Args:
        path: of the folder.
        arrays: arrays of any dtype, by name.
        as_numpy: write one compressed NumPy file instead of Orbax's files.

    Raises:
        OSError: writing failed, for example because the disk is full.
    """
    path = path.resolve()
    _check_space(path.parent, sum(array.nbytes for array in arrays.values()))
    # Orbax writes host arrays only from the main process.
    if as_numpy or jax.process_index() or _NOT_FOR_ORBAX & {*str(path)}:
        path.mkdir()
        write = np.savez_compressed if as_numpy else np.savez
        write(path / _NUMPY, allow_pickle=False, **arrays)
        return
    with _as_os_error(path), _without_logs_of_orbax(), _checkpointer() as checkpointer:
        checkpointer.save(path, arrays)


def _check_space(folder: Path, num_bytes: int) -> None:
    """Check that a disk has room for arrays. Orbax leaves threads behind if it has not."""
    disk = shutil.disk_usage(folder)
    if disk.total and disk.free < num_bytes:  # some network file systems do not know their size
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


@contextlib.contextmanager
def _as_os_error(path: Path) -> Iterator[None]:
    """Context manager that turns TensorStore's error about a file into an `OSError`."""
    try:
        yield
    except ValueError as error:
        code = re.search(r"os_error_code='(\d+)'", str(error))
        if not code:
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1])), str(path)) from error


@contextlib.contextmanager
def _without_logs_of_orbax() -> Iterator[None]:
    """Context manager that hides the tracebacks that Orbax logs from its threads. It raises the same errors."""
    logger = logging.getLogger("absl")
    logger.addFilter(_is_no_error)
    try:
        yield
    finally:
        logger.removeFilter(_is_no_error)


def _is_no_error(record: logging.LogRecord) -> bool:
    return record.levelno < logging.ERROR


def read_arrays(path: Path, expected: Mapping[str, Any], present_name: Callable[[str], str]) -> HostArrays:
    """Read the expected arrays that a folder holds. Other arrays are not read.

    Args:
        path: folder that `write_arrays` wrote.
        expected: arrays or `ShapeDtypeStruct`s by present name.
        present_name: maps a stored name to the present one.

    Raises:
        UserError: an array has another shape or dtype than the expected one.
        ValueError: the folder is damaged.
    """
    read = _read_numpy if (path / _NUMPY).exists() else _read_orbax
    try:
        return read(path, expected, present_name)
    except UserError:
        raise
    except Exception as error:  # archives report damage with many exception types
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise ValueError(f"{path} is damaged: {reason}") from error


def _read_numpy(path: Path, expected: Mapping[str, Any], present_name: Callable[[str], str]) -> HostArrays:
    arrays = {}
    with zipfile.ZipFile(path / _NUMPY) as archive:
        for member in archive.infolist():
            name = present_name(member.filename.removesuffix(".npy"))
            if name not in expected:
                continue
            with archive.open(member) as file:
                if np.lib.format.read_magic(file) != (1, 0):
                    raise ValueError(f"{name} has another version of NumPy's format")
                shape, _, dtype = np.lib.format.read_array_header_1_0(file)
                _check(path, name, expected[name], shape, dtype)
                if member.file_size != file.tell() + math.prod(shape) * dtype.itemsize:
                    raise ValueError(f"{name} has another size than its header says")
            with archive.open(member) as file:
                arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
            if dtype.kind == "V":  # NumPy's files do not support bfloat16
                arrays[name] = arrays[name].view(expected[name].dtype)
    return arrays


def _read_orbax(path: Path, expected: Mapping[str, Any], present_name: Callable[[str], str]) -> HostArrays:
    """Read Orbax's files with TensorStore, which shows the metadata of an array before it reads the array."""
    full = str(path.resolve())  # TensorStore refuses `..`
    if _SEPARATOR in full:
        raise UserError(f"{full} has a backslash, which TensorStore takes for a separator; rename the folder")
    # A URL would read some characters of a path as its own syntax.
    base = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{full}/"}}
    context = tensorstore.Context()
    keys = tensorstore.KvStore.open(base, context=context).result().list().result()
    stored = [key.decode().removesuffix("/.zarray") for key in keys if key.endswith(b"/.zarray")]
    wanted = {present_name(name): name for name in stored if present_name(name) in expected}
    opening = {
        name: tensorstore.open(
            {"driver": "zarr", "kvstore": base | {"path": f"{old}/"}}, open=True, read=True, context=context
        )
        for name, old in wanted.items()
    }
    stores = {name: future.result() for name, future in opening.items()}
    for name, store in stores.items():
        _check(path, name, expected[name], store.shape, store.dtype.numpy_dtype)
        chunk = store.chunk_layout.read_chunk.shape or ()
        if any(size is None or size > max(length, 1) for size, length in zip(chunk, store.shape, strict=True)):
            raise ValueError(f"{name} has larger pieces than its shape")
    reading = {name: store.read() for name, store in stores.items()}
    return {name: np.asarray(future.result()) for name, future in reading.items()}


def _check(path: Path, name: str, expected: Any, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Compare an array's declared shape and dtype with the expected ones."""
    wanted = expected.dtype
    is_bfloat16_in_numpy = wanted.kind == "V" and dtype == np.dtype(f"V{wanted.itemsize}")
    if tuple(shape) != tuple(expected.shape) or not (dtype == wanted or is_bfloat16_in_numpy):
        raise UserError(
            f"{path.parent} belongs to another run or version: "
            f"{name} should be {expected.shape} {expected.dtype}, found {tuple(shape)} {dtype}"
        )


def _checkpointer() -> ocp.Checkpointer:
    """Orbax's checkpointer for this process alone. By default, Orbax waits for all processes."""
    options = ocp.options.MultiprocessingOptions()
    if jax.process_count() > 1:
        rank = jax.process_index()
        options = ocp.options.MultiprocessingOptions(rank, {rank}, f"process_{rank}")
    handler = ocp.PyTreeCheckpointHandler(use_ocdbt=True, use_zarr3=False, multiprocessing_options=options)
    return ocp.Checkpointer(handler, multiprocessing_options=options)
