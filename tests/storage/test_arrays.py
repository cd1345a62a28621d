"""A crafted archive is refused before its arrays are read, whatever it declares and whatever it holds."""

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
import tensorstore
from helpers import CLONE, ENVIRONMENT

from mjx_walk.storage.arrays import read_arrays, write_arrays
from mjx_walk.utils.errors import UserError

EXPECTED = {
    "a": np.arange(6, dtype=np.float32).reshape(2, 3),
    "b": np.zeros((), np.uint32),
    "c": np.asarray(jnp.arange(3, dtype=jnp.bfloat16)),
    "d": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "empty": np.zeros((0, 4), np.float32),
    "zero": np.array([0.0, -0.0], np.float32),
    "flag": np.array([True, False]),
}
HUGE = 1_500_000_000


def same(name):
    return name


def npy(array, declared=None):
    """NumPy's file of an array, with another shape in its header if one is declared."""
    file = io.BytesIO()
    header = np.lib.format.header_data_from_array_1_0(array) | ({"shape": declared} if declared else {})
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + array.tobytes()


def archive(folder, **members):
    folder.mkdir(parents=True)
    with zipfile.ZipFile(folder / "arrays.npz", "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return folder


def zarr(folder, metadata, value=None):
    """An OCDBT store with one array `a`, as Orbax writes it, but for some metadata."""
    base = tensorstore.KvStore.open({"driver": "ocdbt", "base": f"file://{folder}/"}).result()
    usual = {
        **{"chunks": [2, 3], "compressor": {"id": "zstd", "level": 1}, "dimension_separator": ".", "dtype": "<f4"},
        **{"fill_value": None, "filters": None, "order": "C", "shape": [2, 3], "zarr_format": 2},
    }
    base.write(b"a/.zarray", json.dumps(usual | metadata).encode()).result()
    if value is not None:
        base.write(b"a/0.0", value).result()
    return folder


@pytest.mark.parametrize("as_numpy", [True, False])
def test_round_trip_keeps_every_bit_shape_and_type(tmp_path, as_numpy):
    write_arrays(tmp_path / "x", EXPECTED, as_numpy)
    found = read_arrays(tmp_path / "x", EXPECTED, same)
    assert found.keys() == EXPECTED.keys()
    for name, array in EXPECTED.items():
        assert (found[name].shape, found[name].dtype) == (array.shape, array.dtype)
        assert found[name].tobytes() == array.tobytes()


def test_orbax_reads_what_is_written(tmp_path):
    arrays = {name: array for name, array in EXPECTED.items() if array.size}
    write_arrays(tmp_path / "x", arrays)
    with ocp.PyTreeCheckpointer() as checkpointer:
        found = checkpointer.restore(tmp_path / "x")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (npy(np.zeros((2, 4), np.float32)), r"a should be \(2, 3\) float32, found \(2, 4\) float32"),
        (npy(np.zeros((2, 3), np.float64)), r"found \(2, 3\) float64"),
        (npy(np.zeros((2, 3), ">f4")), r"found \(2, 3\) >f4"),
        (npy(np.zeros(1, np.float32), declared=(HUGE, 1000)), r"found \(1500000000, 1000\) float32"),
        (npy(np.zeros((2, 3), np.float32), declared=(-2, -3)), r"found \(-2, -3\) float32"),
        (npy(np.zeros((2, 3), "V4")), r"found \(2, 3\) \|V4"),
    ],
)
def test_another_shape_or_type_in_a_numpy_archive_is_refused(tmp_path, content, says):
    with pytest.raises(UserError, match=says):
        read_arrays(archive(tmp_path / "x", a=content), EXPECTED, same)


class Exploit:
    def __reduce__(self):
        return (print, ("a pickle ran",))


OBJECTS = io.BytesIO()
np.lib.format.write_array(OBJECTS, np.array([[Exploit()] * 3] * 2, dtype=object), allow_pickle=True)


@pytest.mark.parametrize(
    "content",
    [
        npy(np.zeros((2, 3), np.float32)) + b"more than the header says",
        npy(np.zeros((2, 3), np.float32))[:-1],
        pickle.dumps(Exploit()),
        b"",
        b"\x93NUMPY\x02\x00" + b"\xff" * 100,
        b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535,
    ],
)
def test_a_member_that_is_not_what_it_says_is_damage(tmp_path, content):
    with pytest.raises(ValueError, match="is damaged") as error:
        read_arrays(archive(tmp_path / "x", a=content), EXPECTED, same)
    assert not isinstance(error.value, UserError) and "\n" not in str(error.value)


def test_a_header_that_overwhelms_the_parser_is_damage(tmp_path):
    header = b"{'descr': " + b"-" * 9000 + b"1}\n"
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with pytest.raises(ValueError, match="is damaged: the header of a cannot be read"):
        read_arrays(archive(tmp_path / "x", a=content), EXPECTED, same)


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_only_the_compression_of_numpy_is_read(tmp_path, compression):
    (tmp_path / "x").mkdir()
    with zipfile.ZipFile(tmp_path / "x" / "arrays.npz", "w", compression) as file:
        file.writestr("a.npy", npy(EXPECTED["a"]))
    with pytest.raises(ValueError, match="is damaged: a is compressed in a way that NumPy does not use"):
        read_arrays(tmp_path / "x", EXPECTED, same)


def test_an_archive_names_each_array_once_and_is_not_much_larger_than_its_arrays(tmp_path):
    folder = archive(tmp_path / "x", a=npy(EXPECTED["a"]), former=npy(EXPECTED["a"]))
    with pytest.raises(ValueError, match="is damaged: a occurs twice"):
        read_arrays(folder, EXPECTED, lambda name: "a")
    with (folder / "arrays.npz").open("ab") as file:
        file.write(bytes(11_000_000))
    with pytest.raises(ValueError, match="is damaged: it has more than"):
        read_arrays(folder, EXPECTED, same)


def test_a_manifest_of_any_size_does_not_end_the_process(tmp_path):
    write_arrays(tmp_path / "x", EXPECTED)
    os.truncate(tmp_path / "x" / "manifest.ocdbt", 10**11)
    with pytest.raises(ValueError, match="is damaged: it has more than"):
        read_arrays(tmp_path / "x", EXPECTED, same)


def test_a_pickle_in_an_archive_is_not_loaded(tmp_path, capsys):
    with pytest.raises(UserError, match=r"a should be \(2, 3\) float32, found \(2, 3\) object"):
        read_arrays(archive(tmp_path / "x", a=OBJECTS.getvalue()), EXPECTED, same)
    assert "a pickle ran" not in capsys.readouterr().out
    np.load(io.BytesIO(OBJECTS.getvalue()), allow_pickle=True)  # as a proof that it would run
    assert "a pickle ran" in capsys.readouterr().out


def test_member_paths_have_no_effect(tmp_path):
    members = {"../../a": b"x", "/etc/a": b"x", "..\\a": b"x", "a": npy(EXPECTED["a"])}
    found = read_arrays(archive(tmp_path / "deep" / "x", **members), EXPECTED, same)
    assert found.keys() == {"a"}
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["arrays.npz", "deep", "x"]


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        ({"shape": [HUGE, 1000], "chunks": [HUGE, 1]}, r"a should be \(2, 3\) float32, found \(1500000000, 1000\)"),
        ({"dtype": "<f8"}, r"found \(2, 3\) float64"),
        ({"shape": [6], "chunks": [6]}, r"found \(6,\) float32"),
    ],
)
def test_another_shape_or_type_in_an_orbax_folder_is_refused(tmp_path, metadata, says):
    with pytest.raises(UserError, match=says):
        read_arrays(zarr(tmp_path / "x", metadata), EXPECTED, same)


@pytest.mark.parametrize(
    ("metadata", "value"),
    [
        ({"chunks": [HUGE, 1]}, None),
        ({"compressor": None}, b"more than the 24 bytes of the array"),
        ({"dtype": "|O"}, None),
        ({"compressor": {"id": "evil"}}, b"x"),
        ({"zarr_format": 9}, None),
    ],
)
def test_metadata_that_orbax_does_not_write_is_damage(tmp_path, metadata, value):
    with pytest.raises(ValueError, match="is damaged") as error:
        read_arrays(zarr(tmp_path / "x", metadata, value), EXPECTED, same)
    assert not isinstance(error.value, UserError) and "\n" not in str(error.value)


BOMB = """
import resource, sys
from pathlib import Path
import numpy as np
from mjx_walk.storage.arrays import read_arrays
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read_arrays(Path(sys.argv[1]), {"a": np.zeros((2, 3), np.float32)}, lambda name: name)
except ValueError as error:
    print(str(error).count(chr(10)), (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


COMPRESSORS = {"zstd": {"id": "zstd", "level": 1}, "blosc": {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1}}


@pytest.mark.parametrize("kind", ["numpy", "numpy honest", *COMPRESSORS])
def test_a_small_file_that_unpacks_to_much_takes_no_memory(tmp_path, kind):
    size = 300_000_000
    if kind in COMPRESSORS:
        metadata = {"chunks": [size], "shape": [size], "dtype": "|u1", "compressor": COMPRESSORS[kind]}
        large = tensorstore.open(
            {"driver": "zarr", "kvstore": {"driver": "memory"}, "metadata": metadata}, create=True
        ).result()
        large.write(np.ones(size, np.uint8)).result()
        packed = large.kvstore.read(b"0").result().value
        folder = zarr(tmp_path / "x", {"compressor": COMPRESSORS[kind]}, packed)
    else:
        declared = (size // 4,) if kind == "numpy honest" else (2, 3)
        folder = archive(tmp_path / "x", a=npy(np.zeros(size // 4, np.float32), declared))
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 4_000_000
    arguments = [sys.executable, "-c", BOMB, str(folder)]
    done = subprocess.run(arguments, env=ENVIRONMENT, cwd=CLONE, capture_output=True, text=True, check=True)
    lines, megabytes = map(int, done.stdout.split())
    assert lines == 0 and megabytes < 60


@pytest.mark.parametrize("name", ["é 50%41 #a ]b{x} 'q' \"d\" (1):;&|", "?", "[x]", "*", "back\\slash"])
def test_a_folder_may_have_any_name(name, tmp_path):
    arrays = {key: EXPECTED[key] for key in ("a", "flag")}
    write_arrays(tmp_path / name, arrays)
    found = read_arrays(tmp_path / name, arrays, same)
    for key, array in arrays.items():
        np.testing.assert_array_equal(found[key], array)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["?", "[x]", "*", "50%41 #a", "back\\slash"])
def test_arrays_that_are_moved_to_a_folder_of_any_name_can_be_read(name, tmp_path):
    write_arrays(tmp_path / "fine", {"a": EXPECTED["a"]})
    (tmp_path / "fine").rename(tmp_path / name)
    np.testing.assert_array_equal(read_arrays(tmp_path / name, EXPECTED, same)["a"], EXPECTED["a"])


def test_a_path_may_lead_through_parents_and_links(tmp_path, monkeypatch):
    (tmp_path / "back\\slash").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "back\\slash")
    monkeypatch.chdir(tmp_path / "link")
    for path in (Path("../back"), Path("a"), tmp_path / "link" / ".." / "b"):
        write_arrays(path, {"a": EXPECTED["a"]})
        np.testing.assert_array_equal(read_arrays(path, EXPECTED, same)["a"], EXPECTED["a"])
