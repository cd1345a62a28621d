"""A downloaded run folder: where commands write, and what they leave alone."""

import json
import os
import shutil
import zlib

import numpy as np
import pytest
from helpers import OLD_RUNS, command_here, train_here

from mjx_walk import api
from mjx_walk.settings.saved_config import in_short
from mjx_walk.storage import checkpoint
from mjx_walk.storage.background_saver import BackgroundSaver, Part
from mjx_walk.storage.checkpoint_metadata import read_metadata, write_metadata
from mjx_walk.storage.run_folder import RunFolder, open_existing
from mjx_walk.training.checks import prepared
from mjx_walk.utils.errors import UserError


@pytest.fixture
def downloaded(tmp_path):
    return shutil.copytree(OLD_RUNS / "ppo", tmp_path / "downloaded")


def change(run_dir, old, new):
    text = (run_dir / "config.yaml").read_text()
    assert old in text
    (run_dir / "config.yaml").write_text(text.replace(old, new))


def contents(folder):
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_resume_writes_to_the_folder_that_was_named(downloaded, tmp_path):
    """Not to the one that its configuration names, which here holds another run."""
    mine = shutil.copytree(OLD_RUNS / "ppo", tmp_path / "mine")
    saved = next(line for line in (downloaded / "config.yaml").read_text().splitlines() if line.startswith("run_dir:"))
    change(downloaded, saved, f"run_dir: {mine}")
    before = contents(mine)
    train_here(downloaded, "resume=true", "total_steps=32", tiny=[])
    assert contents(mine) == before
    assert [int(path.name) for path in checkpoint.list_steps(downloaded / "checkpoints")][-1] == 32


def test_a_link_above_the_run_folder_is_followed(downloaded, tmp_path):
    """Data folders are often links."""
    (tmp_path / "data").symlink_to(tmp_path, target_is_directory=True)
    assert command_here("eval", f"run={tmp_path}/data/downloaded", "episodes=1") == 0
    assert (downloaded / "eval_gymnasium.json").exists()


def test_hard_links_to_files_outside_are_replaced_by_all_that_write(downloaded, tmp_path):
    names = ("eval_gymnasium.json", "policy.onnx", "page.html", "learning_curve.png", "reward_terms.png")
    names += ("losses.png", "metrics.csv", "metrics.jsonl", "config.yaml")
    outside = tmp_path / "outside"
    outside.mkdir()
    for name in names:
        path = downloaded / name
        shutil.copy(path, outside / name) if path.exists() else (outside / name).write_text("mine")
        path.unlink(missing_ok=True)
        os.link(outside / name, path)
    before = contents(outside)
    run = f"run={downloaded}"
    for command, *arguments in (
        ("train", f"run_dir={downloaded}", "resume=true", "total_steps=32"),
        ("eval", run, "episodes=1"),
        ("play", run, f"html={downloaded}/page.html"),
        ("export", run),
        ("plots", run),
    ):
        assert command_here(command, *arguments) == 0
    assert contents(outside) == before
    assert all((downloaded / name).stat().st_nlink == 1 for name in names)


@pytest.mark.parametrize("name", ["metrics.jsonl", "checkpoints/best/meta.json", "wandb_id.txt"])
def test_a_pipe_in_a_run_folder_is_refused(downloaded, name):
    """A reader would wait for ever."""
    (downloaded / name).unlink(missing_ok=True)
    os.mkfifo(downloaded / name)
    with pytest.raises(UserError, match=f"{name}' is not a regular file; remove it"):
        open_existing(downloaded)


@pytest.mark.parametrize("name", ["meta.json", "run_config.yaml"])
@pytest.mark.parametrize("kind", ["pipe", "device", "large"])
def test_without_a_configuration_no_copy_is_read_for_ever(downloaded, name, kind):
    """Whether a folder is a run depends on its checkpoints then."""
    (downloaded / "config.yaml").unlink()
    folder = RunFolder(downloaded)
    for path in (*checkpoint.list_steps(folder.checkpoints), folder.policy("best"), folder.policy("final")):
        if path.is_dir():
            copy, meta = path / "run_config.yaml", path / "meta.json"
            copy.write_text("x")
            write_metadata(meta, read_metadata(meta) | {"config_crc32": zlib.crc32(b"x")})
            (path / name).unlink()
            if kind == "pipe":
                os.mkfifo(path / name)
            elif kind == "device":
                (path / name).symlink_to("/dev/zero")
            else:
                (path / name).touch()
                os.truncate(path / name, 10**12)
    assert not folder.is_run
    with pytest.raises(UserError, match=r"is not a regular file|is a symbolic link|no run at"):
        open_existing(downloaded)


@pytest.mark.parametrize("name", ["\x1b]0;x\x07", "a\nerror: run this", "\u202egnp"])
def test_a_message_escapes_the_names_in_a_folder(downloaded, name, capsys):
    (downloaded / name).symlink_to("nowhere")
    assert command_here("plots", f"run={downloaded}") == 2
    line = capsys.readouterr().err
    assert line.endswith("' is a symbolic link; replace it by what it points to\n") and line[:-1].isprintable()


def test_of_several_seeds_none_is_a_link_to_another_run(downloaded, tmp_path):
    """The command names only the folder above them, which may be downloaded too."""
    mine = shutil.copytree(OLD_RUNS / "ppo", tmp_path / "mine")
    before = contents(mine)
    downloaded.rename(tmp_path / "seed_0")
    (tmp_path / "seed_1").symlink_to(mine)
    configs = api.resolve_seeds([f"run_dir={tmp_path}", "resume=true"], [0, 1])
    with pytest.raises(UserError, match="seed_1' is a symbolic link"), prepared(configs):
        pass
    assert contents(mine) == before


@pytest.mark.parametrize("name", ["metrics.jsonl", "eval_gymnasium.json", "checkpoints", "checkpoints/best"])
def test_a_folder_in_place_of_a_file_is_refused_and_the_other_way_round(downloaded, name):
    path = downloaded / name
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    path.mkdir() if path.suffix else path.write_text("x")
    with pytest.raises(UserError, match=f"{name}' is a .*remove it"):
        open_existing(downloaded)


def test_a_save_replaces_a_file_in_place_of_a_checkpoint(tmp_path):
    for name in ("best", f".best.{'0' * 16}.unfinished"):
        (tmp_path / name).write_text("x")
    checkpoint.save(tmp_path / "best", {"a": np.zeros(2)}, {})
    checkpoint.prune(tmp_path, max_to_keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["best"] and (tmp_path / "best").is_dir()


def test_a_saved_project_of_weights_and_biases_is_used_only_if_it_is_named(downloaded):
    change(downloaded, "wandb_project: null", "wandb_project: theirs")
    resume = [f"run_dir={downloaded}", "resume=true"]
    with pytest.raises(UserError, match="to continue, add wandb_project=theirs, or wandb_project=null"):
        api.resolve(resume)
    assert api.resolve([*resume, "wandb_project=theirs"]).wandb_project == "theirs"
    assert api.resolve([*resume, "wandb_project=null"]).wandb_project is None


def test_what_a_message_says_to_type_is_quoted(downloaded):
    change(downloaded, "wandb_project: null", "wandb_project: x; touch owned")
    with pytest.raises(UserError, match="add 'wandb_project=x; touch owned', or"):
        api.resolve([f"run_dir={downloaded}", "resume=true"])


def test_later_checkpoints_do_not_crowd_out_new_ones(tmp_path):
    """They are of a run that went on from before them, or a stranger's."""
    tree = {"a": 1.0}
    for steps in (10, 70, 80, 90):
        checkpoint.save(checkpoint.step_path(tmp_path, steps), tree, {"env_steps": steps})
    saver = BackgroundSaver(tmp_path, max_to_keep=2)
    saver.save(Part(checkpoint.step_path(tmp_path, 20), tree, {"env_steps": 20}))
    saver.wait()
    assert [int(path.name) for path in checkpoint.list_steps(tmp_path)] == [10, 20]
    saver.save(Part(tmp_path / "best", tree, {"env_steps": 5}))
    saver.wait()
    assert [int(path.name) for path in checkpoint.list_steps(tmp_path)] == [10, 20]


def test_an_interrupted_wait_does_not_forget_the_save(tmp_path, monkeypatch):
    saver = BackgroundSaver(tmp_path, max_to_keep=1)
    saver.save(Part(checkpoint.step_path(tmp_path, 10), {"a": 1.0}, {"env_steps": 10}))

    def interrupted(running):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("mjx_walk.storage.background_saver.futures.wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            saver.wait()
    saver.wait()
    assert [path.name for path in tmp_path.iterdir()] == ["0000000000010"]


def test_what_a_crash_left_of_a_checkpoint_is_removed_and_of_a_policy_is_kept(tmp_path):
    for name in ("0000000000010", "0000000000020", "best", "final"):
        checkpoint.save(tmp_path / name, {"a": 1.0}, {"env_steps": 10})
    for name in ("0000000000010", "best"):
        (tmp_path / name).rename(tmp_path / f".{name}.0123456789abcdef.unfinished")
    checkpoint.prune(tmp_path, max_to_keep=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".best.0123456789abcdef.unfinished",
        "0000000000020",
        "final",
    ]
    assert checkpoint.find(tmp_path / "best")


def test_a_save_that_fails_leaves_nothing_behind(tmp_path):
    path = checkpoint.step_path(tmp_path, 10)
    checkpoint.save(path, {"a": 1.0}, {"env_steps": 10})
    before = contents(tmp_path)
    with pytest.raises(TypeError):
        checkpoint.save(path, {"a": 2.0}, {"env_steps": object()})
    assert contents(tmp_path) == before and [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_link_put_in_place_of_a_half_written_checkpoint_is_not_followed(tmp_path, monkeypatch):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "meta.json").write_text(json.dumps("mine"))
    monkeypatch.setattr("secrets.token_hex", lambda size: "guessed")
    checkpoints = tmp_path / "checkpoints"
    checkpoints.mkdir()
    (checkpoints / ".best.guessed.unfinished").symlink_to(precious, target_is_directory=True)
    with pytest.raises(FileExistsError):
        checkpoint.save(checkpoints / "best", {"a": 1.0}, {"env_steps": 0})
    assert (precious / "meta.json").read_text() == '"mine"'


def test_a_message_names_the_differences_that_matter():
    few = [f"algo.{name} (was 1, now 2)" for name in "abcde"]
    assert in_short(few) == "; ".join(few)
    assert in_short([*few, "num_envs (was 1, now 2)", "seed (was 1, now 2)"]) == "; ".join([*few, "and 2 more"])
    env = "env.name (was ant, now hopper)"
    assert in_short([*few, env, "seed (was 1, now 2)"]) == f"{env}; and 6 more"
    assert in_short([env, few[0]]) == f"{env}; {few[0]}"
