"""Folders of named arrays, in Orbax's format or as NumPy archives.

A reader trusts no file: before it reads an array, it compares the declared shape and type with the expected ones.
"""

import contextlib
import errno
import json
import math
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import tensorstore

from mjx_walk.storage.files import open_to_read, write_text
from mjx_walk.utils.errors import UserError, failed_read

__all__ = ["HostArrays", "ShapeAndDtype", "read_arrays", "write_arrays"]

_NUMPY = "arrays.npz"
"""File that replaces Orbax's files for small pytrees, and in folders of earlier versions for other processes."""
_METADATA = "_METADATA"
"""Orbax's file about the arrays in a folder."""

_MAX_OVERHEAD, _MAX_OVERHEAD_OF_NUMPY = 100_000_000, 10_000_000
"""Bytes of a folder beyond twice those of its arrays. TensorStore ends the process if its index exceeds the memory,
and Python keeps each entry of an archive's directory there."""
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Kinds that NumPy writes. Python would unpack other kinds without a limit of their memory."""


class ShapeAndDtype(Protocol):
    """An array, or a `jax.ShapeDtypeStruct`."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype: ...


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
    _check_space(path.parent, sum(array.nbytes for array in arrays.values()))
    path.mkdir()
    if as_numpy:
        np.savez_compressed(path / _NUMPY, allow_pickle=False, **arrays)
        return
    with _as_os_error(path), _store(path) as store:
        _write_tensorstore(store, arrays)
    write_text(path / _METADATA, json.dumps(_metadata_of_orbax(arrays)))


def _write_tensorstore(base: dict[str, object], arrays: HostArrays) -> None:
    """Write all arrays in one transaction, each in one chunk, as Orbax does with its defaults.

    Orbax itself writes in an event loop of a thread. After a failed write its other writes continue, and print
    tracebacks from TensorStore's threads.
    """
    context, transaction = tensorstore.Context(), tensorstore.Transaction()
    opening = [
        tensorstore.open(
            {
                "driver": "zarr",
                "kvstore": base | {"path": f"{name}/"},
                "metadata": {"compressor": {"id": "zstd", "level": 1}, "chunks": [max(n, 1) for n in array.shape]},
                "store_data_equal_to_fill_value": True,
            },
            create=True,
            dtype=array.dtype,
            shape=array.shape,
            context=context,
            transaction=transaction,
        )
        for name, array in arrays.items()
    ]
    writing = [store.result().write(array) for store, array in zip(opening, arrays.values(), strict=True)]
    for written in writing:
        written.result()
    transaction.commit_sync()


def _metadata_of_orbax(arrays: HostArrays) -> dict[str, object]:
    """Metadata that Orbax reads to restore the arrays as a dictionary."""
    value = {"value_type": "np.ndarray", "skip_deserialize": False}
    tree = {str((name,)): {"key_metadata": [{"key": name, "key_type": 2}], "value_metadata": value} for name in arrays}
    formats = {"use_ocdbt": True, "use_zarr3": False, "store_array_data_equal_to_fill_value": True}
    return {"tree_metadata": tree} | formats | {"custom_metadata": None}


def _check_space(folder: Path, num_bytes: int) -> None:
    """Check that a disk has room for arrays, before a part of them is written."""
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
def _store(path: Path) -> Iterator[dict[str, object]]:
    """Context manager for TensorStore's description of the files in a folder.

    TensorStore takes a backslash for a separator of folders, so a link without one leads to a path that has it.
    """
    full = path.resolve()  # TensorStore refuses `..`
    with contextlib.ExitStack() as link:
        if "\\" in str(full):
            plain = Path(link.enter_context(tempfile.TemporaryDirectory()), "link")
            plain.symlink_to(full)
            full = plain
        # A URL would read some characters of a path as its own syntax.
        yield {"driver": "ocdbt", "base": {"driver": "file", "path": f"{full}/"}}


def read_arrays(path: Path, expected: Mapping[str, ShapeAndDtype], present_name: Callable[[str], str]) -> HostArrays:
    """Read the expected arrays that a folder holds. Other arrays are not read.

    Args:
        path: folder that `write_arrays` wrote.
        expected: arrays or `ShapeDtypeStruct`s by present name.
        present_name: maps a stored name to the present one.

    Raises:
        UserError: an array has another shape or dtype than the expected one, or a file cannot be read now.
        ValueError: the folder is damaged.
    """
    read = _read_numpy if (path / _NUMPY).exists() else _read_orbax
    try:
        _check_size(path, expected, _MAX_OVERHEAD_OF_NUMPY if read is _read_numpy else _MAX_OVERHEAD)
        with _as_os_error(path):
            return read(path, expected, present_name)
    except (UserError, MemoryError):
        raise
    except OSError as error:
        raise failed_read(path, error) from error
    except Exception as error:  # archives report damage with many exception types
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise ValueError(f"{path} is damaged: {reason}") from error


def _read_numpy(path: Path, expected: Mapping[str, ShapeAndDtype], present_name: Callable[[str], str]) -> HostArrays:
    arrays: HostArrays = {}
    with open_to_read(path / _NUMPY) as content, zipfile.ZipFile(content) as archive:
        for member in archive.infolist():
            name = present_name(member.filename.removesuffix(".npy"))
            if name in arrays:  # ten thousand entries may share the bytes of one
                raise ValueError(f"{name} occurs twice")
            if name in expected:
                arrays[name] = _read_member(path, archive, member, name, expected[name])
    return arrays


def _read_member(
    path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str, expected: ShapeAndDtype
) -> np.ndarray:
    """Read an array of a NumPy archive, after a look at its header."""
    if member.compress_type not in _COMPRESSIONS:
        raise ValueError(f"{name} is compressed in a way that NumPy does not use")
    with archive.open(member) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError(f"{name} uses another version of NumPy's format")
        try:
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        except MemoryError as error:  # so Python's parser reports deep nesting
            raise ValueError(f"the header of {name} cannot be read") from error
        _check(path, name, expected, shape, dtype)
        if member.file_size != file.tell() + math.prod(shape) * dtype.itemsize:
            raise ValueError(f"the size of {name} does not match its header")
    with archive.open(member) as file:
        array = np.lib.format.read_array(file, allow_pickle=False)
    return array.view(expected.dtype) if dtype.kind == "V" else array  # NumPy's files do not support bfloat16


def _read_orbax(path: Path, expected: Mapping[str, ShapeAndDtype], present_name: Callable[[str], str]) -> HostArrays:
    """Read Orbax's files with TensorStore, which shows the metadata of an array before it reads the array."""
    with _store(path) as base:
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
                raise ValueError(f"{name} has chunks larger than its shape")
        reading = {name: store.read() for name, store in stores.items()}
        return {name: np.asarray(future.result()) for name, future in reading.items()}


def _check_size(path: Path, expected: Mapping[str, ShapeAndDtype], overhead: int) -> None:
    """Check that the files of a folder are not much larger than the expected arrays."""
    most = 2 * sum(math.prod(array.shape) * array.dtype.itemsize for array in expected.values()) + overhead
    if sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) > most:
        raise ValueError(f"it has more than {most:,} bytes, twice what its arrays have")


def _check(path: Path, name: str, expected: ShapeAndDtype, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Compare an array's declared shape and dtype with the expected ones."""
    wanted = expected.dtype
    is_bfloat16_in_numpy = wanted.kind == "V" and dtype == np.dtype(f"V{wanted.itemsize}")
    if tuple(shape) != tuple(expected.shape) or not (dtype == wanted or is_bfloat16_in_numpy):
        raise UserError(
            f"{path.parent} belongs to another run or version: "
            f"{name} should be {expected.shape} {expected.dtype}, found {tuple(shape)} {dtype}"
        )
