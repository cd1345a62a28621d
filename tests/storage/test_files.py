"""Files appear completely or not at all, and what a link leads to stays unchanged."""

import os

import pytest

from mjx_walk.storage import files
from mjx_walk.storage.files import open_to_append, replacing, write_text
from mjx_walk.utils.errors import UserError


def test_a_link_is_replaced_and_what_it_leads_to_stays(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / "symbolic.txt").symlink_to(precious)
    (tmp_path / "dangling.txt").symlink_to(tmp_path / "nowhere")
    os.link(precious, tmp_path / "hard.txt")
    for name in ("symbolic", "dangling", "hard"):
        path = tmp_path / f"{name}.txt"
        write_text(path, "new")
        assert path.read_text() == "new" and not path.is_symlink()
    assert precious.read_text() == "mine" and not (tmp_path / "nowhere").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dangling.txt", "hard.txt", "precious", "symbolic.txt"]


def test_a_link_put_in_place_while_the_file_is_written_is_replaced(tmp_path):
    precious, path = tmp_path / "precious", tmp_path / "film.mp4"
    precious.write_text("mine")
    with replacing(path) as new:
        assert new.parent == tmp_path and new.suffix == ".mp4" and new.read_bytes() == b""
        new.write_text("new")
        path.symlink_to(precious)
    assert path.read_text() == "new" and precious.read_text() == "mine"


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file.json"
    path.write_text("old")

    def write_half():
        with replacing(path) as new:
            new.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("file.json", "old")]


def test_two_writers_use_different_names_and_a_name_in_use_is_never_opened(tmp_path, monkeypatch):
    with replacing(tmp_path / "a.json") as one, replacing(tmp_path / "a.json") as other:
        assert one != other
    monkeypatch.setattr("secrets.token_hex", lambda size: "guessed")
    (tmp_path / ".a.guessed.json").symlink_to(tmp_path / "nowhere")
    with pytest.raises(FileExistsError):
        write_text(tmp_path / "a.json", "x")
    assert not (tmp_path / "nowhere").exists()


def test_permissions_are_limited_by_the_umask(tmp_path):
    former = os.umask(0o027)
    try:
        write_text(tmp_path / "usual", "x")
        write_text(tmp_path / "secret", "x", mode=0o600)
    finally:
        os.umask(former)
    assert [(tmp_path / name).stat().st_mode & 0o777 for name in ("usual", "secret")] == [0o640, 0o600]


def test_what_is_not_a_regular_file_is_never_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "folder", tmp_path / "pipe", "/dev/null"):
        with pytest.raises(UserError, match="it is not a regular file; choose another path"):
            write_text(type(tmp_path)(path), "x")
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("open_it", [files.open_to_append, files.open_to_read])
def test_a_pipe_or_a_folder_is_refused_at_once(tmp_path, open_it):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name, says in (("pipe", "not a regular file"), ("folder", "Is a directory")):
        with pytest.raises(OSError, match=f"{says}.*{name}"):
            open_it(tmp_path / name)


def test_no_more_is_read_than_a_file_may_hold(tmp_path):
    (tmp_path / "x").write_bytes(b"12345")
    assert files.read_bytes(tmp_path / "x", 5) == b"12345"
    with pytest.raises(ValueError, match="it is larger than 4 bytes"):
        files.read_bytes(tmp_path / "x", 4)


def test_a_link_below_a_folder_is_refused_and_one_above_is_not(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "link").symlink_to("data")
    files.refuse_links(tmp_path / "link" / "a" / "b", tmp_path / "link")
    with pytest.raises(UserError, match="link' is a symbolic link"):
        files.refuse_links(tmp_path / "link" / "a" / "b", tmp_path)


def test_appending_refuses_a_symbolic_link(tmp_path):
    (tmp_path / "log").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OSError, match="symbolic links"):
        open_to_append(tmp_path / "log")
    assert not (tmp_path / "nowhere").exists()
    for text in ("a", "b"):
        with os.fdopen(open_to_append(tmp_path / "new"), "w") as file:
            file.write(text)
    assert (tmp_path / "new").read_text() == "ab"
