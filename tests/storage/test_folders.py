"""Folders appear completely or not at all, are on the disk first, and survive a crash between any two steps."""

import os

import pytest

from mjx_walk.storage import folders
from mjx_walk.storage.folders import discard, find_written, remove_unfinished, replacing_folder


def write(path, text):
    with replacing_folder(path) as new:
        (new / "last").write_text(text)


def text_of(path):
    return (find_written(path, "last") / "last").read_text()


class Killed(BaseException):
    """The end of the process: no cleanup follows it."""


def kill_at(monkeypatch, call):
    """Let the process end before its n-th rename."""
    replace, calls = os.replace, []

    def counted(*paths):
        calls.append(paths)
        if len(calls) >= call:
            raise Killed
        replace(*paths)

    monkeypatch.setattr(folders.os, "replace", counted)
    monkeypatch.setattr(folders, "_remove", lambda path: None)


@pytest.mark.parametrize("call", [1, 2])
def test_a_crash_before_any_rename_leaves_the_new_folder_or_the_old_one(tmp_path, monkeypatch, call):
    path = tmp_path / "best"
    write(path, "old")
    with monkeypatch.context() as patched:
        kill_at(patched, call)
        with pytest.raises(Killed):
            write(path, "new")
    assert path.exists() == (call == 1)
    assert text_of(path) == ("old" if call == 1 else "new")
    remove_unfinished(tmp_path, keep=[find_written(path, "last")])
    assert text_of(path) == ("old" if call == 1 else "new") and len(list(tmp_path.iterdir())) == 1
    write(path, "newer")
    remove_unfinished(tmp_path, keep=[find_written(path, "last")])
    assert text_of(path) == "newer" and [folder.name for folder in tmp_path.iterdir()] == ["best"]


def test_a_half_written_folder_is_not_found(tmp_path):
    half = tmp_path / f".best.{'0' * 16}.unfinished"
    half.mkdir()
    assert find_written(tmp_path / "best", "last") is None
    remove_unfinished(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_all_files_are_on_the_disk_before_the_name_is(tmp_path, monkeypatch):
    events, fsync, replace = [], os.fsync, os.replace

    def synced(descriptor):
        events.append(os.readlink(f"/proc/self/fd/{descriptor}").partition("unfinished")[2])
        fsync(descriptor)

    def renamed(*paths):
        events.append("renamed")
        replace(*paths)

    monkeypatch.setattr(folders.os, "fsync", synced)
    monkeypatch.setattr(folders.os, "replace", renamed)
    with replacing_folder(tmp_path / "x") as new:
        (new / "part").mkdir()
        (new / "part" / "file").write_text("x")
    assert events == ["/part/file", "/part", "", "renamed", ""]


def test_a_folder_is_gone_at_once(tmp_path, monkeypatch):
    write(tmp_path / "old", "x")
    monkeypatch.setattr(folders, "_remove", lambda path: None)
    discard(tmp_path / "old")
    assert not (tmp_path / "old").exists()
    monkeypatch.undo()
    remove_unfinished(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_an_error_after_the_last_rename_is_the_one_that_is_raised(tmp_path, monkeypatch):
    path = tmp_path / "best"
    write(path, "old")
    sync = folders.sync

    def failing(synced):
        if synced == tmp_path:
            raise OSError(5, "Input/output error")
        sync(synced)

    monkeypatch.setattr(folders, "sync", failing)
    with pytest.raises(OSError, match="Input/output error"):
        write(path, "new")
    assert text_of(path) == "new" and list(tmp_path.iterdir()) == [path]


def test_no_folder_appears_where_the_one_above_has_vanished(tmp_path):
    with pytest.raises(FileNotFoundError):
        write(tmp_path / "run" / "checkpoints" / "best", "x")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("others_file", [None, "theirs"])
def test_a_folder_above_that_is_moved_while_its_content_is_written_is_not_made_anew(tmp_path, others_file):
    """Some writers, such as TensorStore, make all folders that they miss."""
    run = tmp_path / "runs" / "run"
    run.mkdir(parents=True)

    def write_while_it_is_moved():
        with replacing_folder(run / "checkpoints" / "1") as new:
            (tmp_path / "runs").rename(tmp_path / "moved")
            new.mkdir(parents=True)
            (new / "last").touch()
            if others_file:
                (run / others_file).touch()

    with pytest.raises(FileNotFoundError, match="a folder above was moved or removed"):
        write_while_it_is_moved()
    left = [path.name for path in (tmp_path / "runs").rglob("*")]
    assert left == (["run", "theirs"] if others_file else []) and (tmp_path / "runs").exists() == bool(others_file)
