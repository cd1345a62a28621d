"""Weights & Biases, offline."""

import importlib.util
import json
import subprocess

import pytest
from helpers import TINY, TINY_CALL, command
from wandb.proto.wandb_internal_pb2 import Record

import mjx_walk.api
from mjx_walk.settings.config import load_config
from mjx_walk.settings.saved_config import save_config
from mjx_walk.utils.errors import UserError


def records(data):
    """W&B's file: a header of 7 bytes, then records in LevelDB's log format, split over blocks of 32 KiB."""
    at, parts = 7, b""
    while at + 7 <= len(data):
        if 32768 - at % 32768 < 7:  # too little room for a fragment's header
            at += 32768 - at % 32768
            continue
        size, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        parts += data[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # a complete record, or its last fragment
            yield Record.FromString(parts)
            parts = b""


def history(path):
    """Step and values of all rows."""
    rows = {}
    for record in records(path.read_bytes()):
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            values = {item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in items}
            rows[int(values["_step"])] = values
    return rows


@pytest.mark.slow
def test_rows_are_logged_and_a_resumed_run_continues_the_same_one(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    arguments = [*TINY, f"run_dir={tmp_path}/run", "wandb_project=walking"]
    mjx_walk.run([*arguments, f"total_steps={3 * TINY_CALL}"])
    run = mjx_walk.run([*arguments, f"total_steps={6 * TINY_CALL}", "resume=true"])
    files = sorted((tmp_path / "run" / "wandb").glob("offline-run-*/run-*.wandb"))
    identity = (tmp_path / "run" / "wandb_id.txt").read_text()
    assert len(files) == 2 and {path.stem for path in files} == {f"run-{identity}"}
    logged = history(files[0]) | history(files[1])
    assert list(logged) == [row["env_steps"] for row in run.metrics] and len(logged) == 6
    for row in run.metrics[1:]:
        assert logged[row["env_steps"]]["train/loss"] == pytest.approx(row["train/loss"])


def test_a_run_may_be_logged_and_filmed_from_its_resumption_on(tmp_path):
    config = load_config(["env=walker2d", "hardware=cpu", "algo.discount=0.9"])
    save_config(config, tmp_path / "config.yaml")
    wishes = ["wandb_project=walking", "evaluation.films=true", "total_steps=7"]
    resumed = mjx_walk.api.resolve([f"run_dir={tmp_path}", "resume=true", *wishes])
    assert resumed.wandb_project == "walking" and resumed.evaluation.films and resumed.total_steps == 7
    assert resumed.algo == config.algo and resumed.evaluation.num_envs == config.evaluation.num_envs


def test_without_the_package_nothing_is_begun(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="wandb_project=walking needs Weights & Biases: pip install wandb"):
        mjx_walk.run([*TINY, f"run_dir={tmp_path}/run", "wandb_project=walking"])
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_without_a_login_nothing_is_begun(tmp_path):
    """In a process of its own, which has no terminal to ask."""
    env = {"HOME": str(tmp_path), "WANDB_MODE": "online", "WANDB_SILENT": "true", "WANDB_API_KEY": ""}
    arguments = [*TINY, f"run_dir={tmp_path}/run", "wandb_project=walking"]
    done = command("train", *arguments, env=env, stdin=subprocess.DEVNULL)
    assert done.returncode == 2 and not (tmp_path / "run").exists()
    assert done.stderr == "error: wandb_project=walking: log in with `wandb login`, or set WANDB_MODE=offline\n"
