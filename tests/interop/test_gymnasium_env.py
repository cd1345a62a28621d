"""The tasks through Gymnasium's interface."""

import copy
import pickle
import shutil
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit
from helpers import ENVIRONMENT, renders
from side_by_side import IDS, REGISTERED, assert_same, make_both, outcome

from mjx_walk.envs import GYMNASIUM_TASKS, TASKS, make_env
from mjx_walk.envs.model_files import ASSETS
from mjx_walk.interop import gymnasium_programs
from mjx_walk.utils.errors import UserError


def test_every_task_is_registered():
    specs = [gymnasium.spec(name) for name in REGISTERED]
    assert {spec.kwargs["env"] for spec in specs} == {*GYMNASIUM_TASKS} and len(REGISTERED) == 2 * len(GYMNASIUM_TASKS)
    for spec in specs:
        task, options = TASKS[spec.kwargs["env"]]
        assert (spec.name, spec.max_episode_steps) == (task.GYMNASIUM_NAME, options().max_episode_steps)


@pytest.mark.parametrize("make", [gymnasium.make, lambda name: gymnasium.make_vec(name, num_envs=2)])
def test_what_gymnasium_does_not_support_is_refused(make):
    with pytest.raises(UserError, match="Pusher-v4 only with MuJoCo below 3; choose one of: v5"):
        make("mjx_walk/Pusher-v4")
    with pytest.raises(ImportError, match="mujoco<3"):
        gymnasium.make("Pusher-v4")


@pytest.mark.filterwarnings("ignore")  # about unbounded observations
@pytest.mark.parametrize("name", IDS)
def test_every_task_is_gymnasiums(name):
    """Spaces, starts of a seed, steps, info and four wrappers, on the engine that is MuJoCo's C library."""
    ours, real = make_both(name)
    check_env(ours.unwrapped, skip_render_check=True)
    assert ours.metadata == real.metadata and ours.spec.max_episode_steps == real.spec.max_episode_steps
    assert ours.unwrapped.model.nq == real.unwrapped.model.nq and ours.unwrapped.dt == real.unwrapped.dt
    assert_same(outcome(wrapped, ours), outcome(wrapped, real), atol=5e-3)


def wrapped(env):
    """Four wrappers. The time limit ends the episode, with its statistics, in the last step."""
    env = wrappers.ClipAction(wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(env, 12)))
    return wrappers.FrameStackObservation(env, 2)


def test_steps_are_gymnasiums_own():
    """From the same state under the same actions, on the engine that is MuJoCo's C library."""
    env = gymnasium.make("mjx_walk/Walker2d-v5", physics="c")
    real = gymnasium.make("Walker2d-v5")
    obs, _ = env.reset(seed=3)
    real.reset()
    qpos, qvel = np.split(env.unwrapped.state_vector(), 2)
    real.unwrapped.set_state(qpos, qvel)
    rng = np.random.default_rng(0)
    for _ in range(15):
        action = rng.uniform(-1, 1, 6)
        obs, reward, terminated, truncated, info = env.step(action)
        expected = real.step(np.float64(np.float32(action)))
        np.testing.assert_allclose(obs, expected[0], atol=1e-3)
        assert reward == pytest.approx(expected[1], abs=1e-3)
        assert (terminated, truncated) == expected[2:4]
        assert info["reward_forward"] == pytest.approx(expected[4]["reward_forward"], abs=1e-3)


def test_there_is_one_time_limit():
    env = gymnasium.make("mjx_walk/HumanoidStandup-v5", physics="c", max_episode_steps=7)
    limits, layer = 0, env
    while layer is not env.unwrapped:
        limits += isinstance(layer, TimeLimit)
        layer = layer.env
    assert limits == 1
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]
    with pytest.raises(gymnasium.error.ResetNeeded):
        gymnasium.make("mjx_walk/Walker2d-v5", physics="c").unwrapped.step(np.zeros(6))


def test_its_keywords_are_gymnasiums():
    env = gymnasium.make("mjx_walk/Humanoid-v5", physics="c", include_cfrc_ext_in_observation=False)
    assert (
        env.observation_space.shape
        == gymnasium.make("Humanoid-v5", include_cfrc_ext_in_observation=False).observation_space.shape
    )
    assert make_env("humanoid", "c").observation_size == 348 > env.observation_space.shape[0]


def test_a_wrong_action_raises_before_anything_runs():
    env = gymnasium.make("mjx_walk/Walker2d-v5", physics="c")
    env.reset(seed=0)
    before = env.unwrapped.state_vector()
    for action in (0.3, np.zeros(1), np.zeros(5), np.zeros((1, 6)), np.zeros((6, 1))):
        with pytest.raises(ValueError, match=r"Action dimension mismatch. Expected \(6,\), found"):
            env.step(action)
    np.testing.assert_array_equal(env.unwrapped.state_vector(), before)


def test_copies_and_pickles_go_on_alike():
    env = gymnasium.make("mjx_walk/Walker2d-v5", physics="c", max_episode_steps=20)
    env.reset(seed=0)
    env.step(np.full(6, 0.5))
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(3):
        expected = env.step(np.full(6, -0.5))
        for other in copies:
            assert_same(other.step(np.full(6, -0.5)), expected, atol=0)
    expected, _ = env.reset()
    for other in copies:
        np.testing.assert_array_equal(other.reset()[0], expected)
        assert other.action_space == env.action_space and other.spec == env.spec
    assert gymnasium.make(env.spec).spec == env.spec


def test_what_it_returns_may_be_written_to():
    env = gymnasium.make("mjx_walk/Humanoid-v5", physics="c")
    first, info = env.reset(seed=0)
    kept = first.copy()
    first[:] = 0.0
    info["tendon_length"][:] = 0.0
    assert env.observation_space.contains(kept)
    np.testing.assert_array_equal(env.reset(seed=0)[0], kept)


def test_attributes_of_mujoco_environments():
    ours, real = make_both("Walker2d-v5", width=64, height=48)
    ours, real = ours.unwrapped, real.unwrapped
    for name in ("dt", "frame_skip", "observation_structure", "width", "height", "camera_id", "camera_name"):
        assert getattr(ours, name) == getattr(real, name), name
    np.testing.assert_array_equal(ours.init_qpos, real.init_qpos)
    np.testing.assert_array_equal(ours.init_qvel, real.init_qvel)
    qpos = real.init_qpos + 0.125
    ours.set_state(qpos, real.init_qvel + 0.25)
    np.testing.assert_array_equal(ours.state_vector(), [*qpos, *(real.init_qvel + 0.25)])
    real.set_state(qpos, real.init_qvel + 0.25)
    np.testing.assert_allclose(ours.get_body_com("foot"), real.get_body_com("foot"))
    assert_same(ours.step(np.full(6, 0.5)), real.step(np.full(6, 0.5)))
    with pytest.raises(AssertionError):
        ours.set_state(np.zeros(3), np.zeros(9))


def test_info_says_that_the_physics_is_not_finite():
    """Gymnasium has no such entry, and resets the simulation in silence."""
    env = gymnasium.make("mjx_walk/HalfCheetah-v5", physics="c").unwrapped
    env.reset(seed=0)
    env.set_state(env.init_qpos, np.full(9, 9e9))
    _, reward, terminated, _, info = env.step(np.zeros(6))
    assert terminated and reward == 0.0 and info["nonfinite"] == 1.0


def test_a_window_needs_a_screen(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(UserError, match="render_mode='human' needs a screen; use render_mode='rgb_array'"):
        gymnasium.make("mjx_walk/Walker2d-v5", physics="c", render_mode="human")


WINDOW = """
import glfw, gymnasium, mjx_walk
env = gymnasium.make("mjx_walk/Walker2d-v5", physics="c", render_mode="human")
env.reset(seed=0)
for _ in range(3):
    env.step(env.action_space.sample())
window = env.unwrapped.mujoco_renderer.viewer.window
print(glfw.get_window_attrib(window, glfw.VISIBLE), glfw.get_window_size(window))
env.close()
"""


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("xvfb-run"), reason="there is no virtual screen")
def test_a_window_opens_on_a_screen():
    environment = {name: value for name, value in ENVIRONMENT.items() if name != "MUJOCO_GL"}
    screen = ["xvfb-run", "--auto-servernum", "--server-args=-screen 0 1280x800x24"]
    done = subprocess.run([*screen, sys.executable, "-c", WINDOW], capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "1 (480, 480)", done.stderr


def make_or_make_vec(num_envs):
    name = "mjx_walk/InvertedPendulum-v5"
    return gymnasium.make_vec(name, num_envs, physics="c") if num_envs else gymnasium.make(name, physics="c")


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_changed_model_is_not_ignored(num_envs):
    env = make_or_make_vec(num_envs)
    env.reset(seed=0)
    model = env.get_attr("model")[-1] if num_envs else env.unwrapped.model
    model.light_pos[:] = 0.0
    env.reset()
    model.qpos_spring[0] = 0.1
    for call in (env.reset, lambda: env.step(env.action_space.sample())):
        with pytest.raises(UserError, match=r"ignores your change to model\.qpos_spring; use xml_file=PATH"):
            call()


@pytest.mark.parametrize("num_envs", [None, 2])
def test_attributes_without_effect_cannot_be_set(num_envs):
    env = make_or_make_vec(num_envs)
    part = env.envs[-1] if num_envs else env.unwrapped
    with pytest.raises(UserError, match=r"ignores your value of _reset_noise_scale; give reset_noise_scale=… to"):
        part._reset_noise_scale = 0.0
    with pytest.raises(UserError, match="ignores your value of data; use set_state instead"):
        part.data = None
    for method in ("reset_model", "_get_obs", "do_simulation", "set_state"):
        with pytest.raises(UserError, match=f"ignores your value of {method}; write a task of your own instead"):
            setattr(part, method, print)
    with pytest.raises(UserError, match=r"ignores your value of dt$"):
        part.dt = 0.1
    part.my_note = 1
    assert part.my_note == 1


def test_the_start_can_be_set():
    env = make_or_make_vec(None).unwrapped
    env.init_qpos = np.array([0.5, 0.0])
    first = env.reset(seed=0)[0]
    assert abs(first[0] - 0.5) < 0.02
    np.testing.assert_array_equal(copy.deepcopy(env).reset(seed=0)[0], first)
    envs = make_or_make_vec(2)
    envs.envs[0].init_qpos[0] = 0.5
    with pytest.raises(UserError, match="resets on the device ignore your change to init_qpos; use vectorization_mode"):
        envs.reset()


@renders
@pytest.mark.parametrize("mode", ["rgb_array", "depth_array", "rgbd_tuple", "rgb_array_list"])
def test_frames_are_gymnasiums(mode):
    keywords = {"render_mode": mode, "width": 80, "height": 64, "camera_name": "track", "max_geom": 100}
    frames = []
    for env in make_both("Walker2d-v5", **keywords):
        env.reset(seed=0)
        env.step(np.full(6, 0.5))
        frames.append(env.render())
        env.close()
    assert_same(*frames)


def test_a_forked_process_is_told_to_spawn(monkeypatch):
    """JAX would wait for ever. Spaces and resets, which need no JAX, are given: a worker may ask for them too early."""
    expected, _ = gymnasium.make("Walker2d-v5").reset(seed=0)
    monkeypatch.setattr(gymnasium_programs, "_process_of_jax", [1])
    env = gymnasium.make("mjx_walk/Walker2d-v5", physics="c")
    assert env.observation_space.shape == (17,)
    np.testing.assert_array_equal(env.reset(seed=0)[0], np.float32(expected))
    for call in (lambda: env.step(np.zeros(6)), env.unwrapped.state_vector):
        with pytest.raises(gymnasium.error.Error, match=r"vector_kwargs={'context': 'spawn'}"):
            call()


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_copy_warns_if_the_model_file_has_changed(num_envs, tmp_path, caplog):
    path = tmp_path / "mine.xml"
    path.write_bytes((ASSETS / "inverted_pendulum.xml").read_bytes())
    settings = {"physics": "c", "xml_file": str(path)}
    name = "mjx_walk/InvertedPendulum-v5"
    env = gymnasium.make_vec(name, num_envs, **settings) if num_envs else gymnasium.make(name, **settings)
    copy.deepcopy(env)
    assert not caplog.text
    path.write_text(path.read_text().replace('gear="100"', 'gear="50"'))
    copy.deepcopy(env)
    assert f"{path} has changed since it was loaded; it is used as it is now" in caplog.text
