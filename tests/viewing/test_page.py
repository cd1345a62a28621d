"""The page that plays an episode, and how a browser shows it."""

import base64
import json
import re
import shutil
import subprocess

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest

import mjx_walk
from mjx_walk.envs import View
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing import page
from mjx_walk.viewing.episode import Episode, record_episode

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

EVERY_SHAPE = """
<mujoco>
  <asset><mesh name="tetrahedron" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1" pos="0 0 -0.5"/>
    <body pos="0 0 1"><freejoint/>
      <geom type="sphere" size="0.1"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/>
      <geom type="ellipsoid" size="0.1 0.2 0.3"/><geom type="cylinder" size="0.1 0.2"/>
      <geom type="box" size="0.1 0.2 0.3" rgba="1 0 0 0.5"/><geom type="mesh" mesh="tetrahedron"/>
      <geom type="sphere" size="9" group="3"/><geom type="sphere" size="9" rgba="1 1 1 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def episode():
    run = mjx_walk.load_run("zoo:walker2d-sac", "c")
    return record_episode(run.task, run.policy, seed=1)


def read_data(path):
    return json.loads(re.search(r'id="episode" type="application/json">(.*?)</script>', path.read_text(), re.S)[1])


def test_the_page_holds_the_episode_and_needs_nothing_else(tmp_path, episode):
    path = page.write_page(episode, tmp_path / "walk.html")
    text = path.read_text()
    ours = text.replace(page.require_library().read_text(), "")
    assert len(ours) < len(text) and not re.search(r"https?://|src=|<link|import ", ours)
    data = read_data(path)
    assert data["num_steps"] == 1000 and data["returns"][-1] == pytest.approx(episode.rewards.sum(), abs=0.01)
    for name, values in episode.reward_terms.items():
        np.testing.assert_allclose(data["series"][name], values, atol=1e-4)
    poses = np.frombuffer(base64.b64decode(data["poses"]), "<f4").reshape(1000, episode.model.nbody, 7)
    # `xpos` after a step is that of RK4's last stage, not quite that of `qpos`.
    np.testing.assert_allclose(poses[:, 1, :3], episode.body, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(poses[..., 3:], axis=-1), 1.0, atol=1e-6)
    # The torso's rotation is MuJoCo's, with the real part last.
    pitch = episode.qpos[:, 2]
    np.testing.assert_allclose(np.abs(poses[:, 1, 6]), np.abs(np.cos(pitch / 2)), atol=1e-5)
    assert len(data["geoms"]) == 7 and {geom["type"] for geom in data["geoms"]} == {"capsule"} and data["floors"] == [0]


def test_every_shape_that_is_seen_is_drawn(tmp_path):
    model = mujoco.MjModel.from_xml_string(EVERY_SHAPE)
    standing = np.tile(model.qpos0, (2, 1))
    metadata = {"seconds_per_step": 0.1, "body": standing[:, :3], "motor_forces": np.zeros((2, 0)), "view": View()}
    nothing = {"floor_contacts": np.zeros((2, 2), bool), "frames": [], "steps_per_frame": 1}
    terms = {"reward_a</script>": np.ones(2)}
    made = Episode("Own", False, model, qpos=standing, rewards=np.ones(2), reward_terms=terms, **metadata, **nothing)
    data = read_data(page.write_page(made, tmp_path / "own.html"))
    assert [geom["type"] for geom in data["geoms"]] == ["sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh"]
    assert data["geoms"][4]["rgba"] == [1, 0, 0, 0.5] and data["floors"] == [-0.5]
    assert len(data["geoms"][5]["vertices"]) == 12 and len(data["geoms"][5]["faces"]) == 12
    assert list(data["series"]) == ["reward_a</script>"]


def browse(path, at, *options):
    """What the browser prints, and what it complains about."""
    run = subprocess.run(
        [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--enable-logging=stderr",
            "--window-size=1000,600",
            "--virtual-time-budget=4000",
            *options,
            f"file://{path}#t={at}",
        ],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stdout, [line for line in run.stderr.splitlines() if "CONSOLE" in line]


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt-get install chromium")
def test_a_browser_plays_it(tmp_path, episode):
    path = page.write_page(episode, tmp_path / "walk.html")
    pictures = []
    for at in (0.4, 6.0):
        dom, complaints = browse(path, at, "--dump-dom")
        step = round(at / 0.008) - 1
        shown = dict(re.findall(r"<tr><td[^>]*>([^<]+)</td><td>([^<]+)</td>", dom))
        assert not complaints
        assert float(shown["time (s)"]) == pytest.approx(at)
        assert float(shown["return so far"]) == pytest.approx(episode.rewards[: step + 1].sum(), abs=0.06)
        assert float(shown["torso height (m)"]) == pytest.approx(episode.body[step, 2], abs=0.006)
        forward = float(shown["reward_forward"])
        assert forward == pytest.approx(episode.reward_terms["reward_forward"][step], abs=6e-4)
        browse(path, at, f"--screenshot={tmp_path}/{at}.png")
        pictures.append(iio.imread(tmp_path / f"{at}.png")[..., :3].astype(float))
    for picture in pictures:
        assert picture.shape == (600, 1000, 3)
        # The walker's left leg is purple, which nothing else on the page is; it stays in the middle of the view.
        purple = (picture[..., 0] > picture[..., 1] + 40) & (picture[..., 2] > picture[..., 1] + 40)
        columns = np.flatnonzero(purple[:, :640].any(axis=0))
        assert columns.size > 10 and 180 < columns.mean() < 480
    assert np.abs(pictures[0] - pictures[1])[:, :640].mean() > 1.0


def test_without_the_library_there_is_one_line(monkeypatch):
    monkeypatch.setattr(page.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="html= needs MeshCat, whose 3D viewer the page embeds"):
        page.require_library()
