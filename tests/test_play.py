"""Films and gait sheets, from the real Gymnasium."""

import os
import subprocess
import sys

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
from helpers import ENVIRONMENT, command, command_here, renders

import mjx_walk
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing import rendering
from mjx_walk.viewing.episode import record_episode


@pytest.fixture(scope="module")
def run():
    return mjx_walk.load_run("zoo:walker2d-sac", "c")


@renders
@pytest.mark.slow
def test_film_follows_the_walker_in_real_time(tmp_path, run):
    done = command("play", "run=zoo:walker2d-sac", f"out={tmp_path}/new/walk.mp4", "width=321", "height=240")
    assert done.returncode == 0 and "return 7," in done.stdout, done.stderr
    film = tmp_path / "new" / "walk.mp4"
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(film))
    assert seconds == pytest.approx(8.0, abs=0.1) and frames == 250
    early, late = (iio.imread(film, index=index, plugin="FFMPEG").astype(float) for index in (10, 240))
    assert early.shape == (240, 320, 3)
    # The walker, and nothing else here, is purple; after 50 m it still has to be in the middle.
    for frame in (early, late):
        purple = (frame[..., 0] > frame[..., 1] + 40) & (frame[..., 2] > frame[..., 1] + 40)
        columns = np.flatnonzero(purple.any(axis=0))
        assert columns.size > 10 and 80 < columns.mean() < 240


def test_an_episode_holds_what_gymnasium_says(run):
    episode = record_episode(run.task, run.policy, seed=3)
    assert not episode.frames and len(episode.rewards) == 1000
    total = sum(episode.reward_terms.values())
    np.testing.assert_allclose(episode.rewards, total, atol=1e-9)
    assert episode.rewards.sum() == pytest.approx(run.evaluate(1, seed=3).mean, rel=1e-6)
    # It runs: the torso gets far, the feet and no other body touch the floor, and the motors stay within their gears.
    assert episode.body[-1, 0] > 30 and episode.seconds[-1] == pytest.approx(8.0)
    touching = episode.floor_contacts.mean(axis=0)
    names = [episode.model.body(i).name for i in np.flatnonzero(touching > 0.01)]
    assert sorted(names) == ["foot", "foot_left"] and 0.1 < touching.max() < 0.9
    assert 50 < np.abs(episode.motor_forces).max() <= 100.0


@renders
@pytest.mark.slow
def test_gait_sheet(tmp_path):
    done = command(
        "play",
        "run=zoo:walker2d-td3",
        f"gait={tmp_path}/gait.png",
        f"strip={tmp_path}/strip.png",
        "width=240",
        "height=180",
    )
    assert done.returncode == 0 and "Walker2d-v5: return 6," in done.stdout, done.stderr
    image = iio.imread(tmp_path / "gait.png")
    assert image.shape[0] > 1000 and image.std() > 20
    strip = iio.imread(tmp_path / "strip.png")
    assert strip.shape == (180, 8 * 120, 3)
    first, last = strip[:, :120].astype(float), strip[:, -120:].astype(float)
    assert np.abs(first - last).mean() > 5
    assert not list(tmp_path.glob("*.mp4"))


def test_play_prints_a_one_line_error(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (tmp_path / "file").write_text("")
    for arguments, message in (
        ((), "say which run: run=RUN_DIR, or run=zoo:NAME; python -m mjx_walk.zoo lists the names"),
        (("run=nowhere",), "no run at 'nowhere'"),
        (("run=zoo:walker2d-sac", f"out={tmp_path}/file/walk.mp4"), f"cannot write {tmp_path}/file/walk.mp4"),
        (("run=zoo:walker2d-sac", f"html={tmp_path}/file/walk.html"), f"cannot write {tmp_path}/file/walk.html"),
        (("run=zoo:walker2d-sac", "out=walk"), "walk: give it one of these endings: .mp4, .mkv, .mov, .avi"),
        (("run=zoo:walker2d-sac", "gait=x.foo"), "x.foo: give it one of these endings: .png, .jpg"),
        (("run=zoo:walker2d-sac", "width=20000"), "width=20000: must be at most 4096"),
        (("run=zoo:walker2d-sac", "viewer=true"), "viewer=true needs a screen"),
    ):
        assert command_here("play", *arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ") and message in line


@pytest.mark.slow
def test_jax_has_not_chosen_a_device_before_the_command_does():
    """Else `stay_on_cpu` would come too late where there is a GPU."""
    code = "import mjx_walk.play, mjx_walk.export; from jax._src import xla_bridge; print(list(xla_bridge._backends))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT, check=True)
    assert done.stdout == "[]\n"


def test_opengl_is_chosen_and_what_is_missing_is_said(monkeypatch):
    def choose(given, works):
        monkeypatch.setenv("MUJOCO_GL", given)
        monkeypatch.setattr(rendering, "_works", works.__contains__)
        rendering.choose_opengl()
        return os.environ["MUJOCO_GL"]

    monkeypatch.setattr(rendering.sys, "platform", "linux")
    assert choose("glfw", ["egl", "glfw"]) == "glfw"  # the user's stays
    assert choose("", ["egl", "osmesa"]) == "egl"
    assert choose("", ["osmesa"]) == "osmesa"
    valid = {"foo": "egl or osmesa", "egl": "osmesa", "osmesa": "egl", "glfw": "egl or osmesa", "EGL": "egl or osmesa"}
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for display in ("", ":0"):
        monkeypatch.setenv("DISPLAY", display) if display else monkeypatch.delenv("DISPLAY", raising=False)
        for given, others in valid.items():
            also = " or glfw" if display and given != "glfw" else ""
            with pytest.raises(UserError) as refused:
                choose(given, ["EGL"])
            assert str(refused.value) == f"MUJOCO_GL={given} does not render here; unset it, or try {others}{also}"
    with pytest.raises(UserError, match="nothing to render with: install EGL or OSMesa"):
        choose("", [])


def test_a_renderer_is_tried_in_a_process_of_its_own(monkeypatch):
    for probe, works in (("import os; assert os.environ['MUJOCO_GL'] == 'x'", True), ("raise SystemExit(1)", False)):
        monkeypatch.setattr(rendering, "_PROBE", probe)
        assert rendering._works.__wrapped__("x") is works
    monkeypatch.setattr(rendering, "_PROBE", "import time; time.sleep(60)")  # a driver that hangs
    monkeypatch.setattr(rendering, "_PROBE_SECONDS", 0.2)
    assert rendering._works.__wrapped__("x") is False


@pytest.mark.slow
@pytest.mark.parametrize("value", ["foo", "osmesa", ""])
def test_only_rendering_needs_a_working_opengl(value, tmp_path):
    """OSMesa's library is missing on most machines; where it is installed, the film is written."""
    env = ENVIRONMENT | {"MUJOCO_GL": value}
    assert command("play", "run=zoo:walker2d-sac", f"html={tmp_path}/page.html", env=env).returncode == 0
    film = command("play", "run=zoo:walker2d-sac", f"out={tmp_path}/film.mp4", env=env)
    if film.returncode:
        assert film.returncode == 2 and len(film.stderr.splitlines()) == 1
        assert film.stderr.startswith(f"error: MUJOCO_GL={value} does not render" if value else "error: nothing to")
    else:
        assert value != "foo"
