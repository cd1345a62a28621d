"""Which commit the package runs from."""

import subprocess

from mjx_walk.utils import versions


def git(folder, *arguments):
    author = ("-c", "user.name=a", "-c", "user.email=a@localhost")
    subprocess.run(["git", "-C", folder, *author, *arguments], check=True, capture_output=True)


def test_only_a_clone_has_a_commit(tmp_path, monkeypatch):
    file = tmp_path / "clone" / "mjx_walk" / "utils" / "versions.py"
    file.parent.mkdir(parents=True)
    file.write_text("")
    monkeypatch.setattr(versions, "__file__", str(file))
    git(tmp_path, "init")  # another project, in which the package is installed
    assert versions.git_commit() is None
    git(tmp_path / "clone", "init")
    assert versions.git_commit() is None  # no commit yet
    git(tmp_path / "clone", "add", ".")
    git(tmp_path / "clone", "commit", "-m", "first")
    commit = versions.git_commit()
    assert len(commit) == 40 and int(commit, 16)
    file.write_text("changed")
    assert versions.git_commit() == f"{commit}-dirty"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert versions.git_commit() is None
