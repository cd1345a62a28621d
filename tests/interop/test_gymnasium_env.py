"""The tasks through Gymnasium's interface."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit

import mjx_walk  # noqa: F401  registers the names
from mjx_walk.envs import TASKS, make_env
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.quiet_mujoco import hide_deprecations

REGISTERED = [name for name in gymnasium.registry if name.startswith("mjx_walk/")]
NAMES = [name for name in REGISTERED if name != "mjx_walk/Pusher-v4"]


def test_every_task_is_registered():
    specs = [gymnasium.spec(name) for name in REGISTERED]
    assert {spec.kwargs["env"] for spec in specs} == TASKS.keys() and len(REGISTERED) == 2 * len(TASKS)
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
@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_accepts_it(name):
    env = gymnasium.make(name, physics="c")
    check_env(env.unwrapped, skip_render_check=True)
    with hide_deprecations():
        theirs = gymnasium.make(name.removeprefix("mjx_walk/"))
    assert env.observation_space.shape == theirs.observation_space.shape
    np.testing.assert_array_equal(env.action_space.high, theirs.action_space.high)


def test_steps_are_gymnasiums_own():
    """From the same state under the same actions, on the engine that is MuJoCo's C library."""
    env = gymnasium.make("mjx_walk/Walker2d-v5", physics="c")
    real = gymnasium.make("Walker2d-v5")
    obs, _ = env.reset(seed=3)
    real.reset()
    state = env.unwrapped._state.physics
    real.unwrapped.set_state(np.float64(state.qpos), np.float64(state.qvel))
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


@pytest.mark.parametrize("physics", ["c", pytest.param("jax", marks=pytest.mark.slow)])
def test_many_side_by_side(physics):
    """Environments that fall or reach the limit reset in the same step. Their last observation is in `final_obs`."""
    envs = gymnasium.make_vec(
        "mjx_walk/Walker2d-v5", num_envs=6, physics=physics, max_episode_steps=20, autoreset_mode="SameStep"
    )
    obs, _ = envs.reset(seed=1)
    again, _ = envs.reset(seed=1)
    np.testing.assert_array_equal(obs, again)
    assert len({tuple(row) for row in obs}) == 6 and envs.observation_space.contains(obs)
    rng = np.random.default_rng(0)
    healthy_z, fell, cut = (0.8, 2.0), 0, 0
    ages = np.zeros(6, int)
    for _ in range(100):
        obs, reward, terminated, truncated, info = envs.step(rng.uniform(-1, 1, (6, 6)))
        ages += 1
        over = terminated | truncated
        assert reward.shape == (6,) and info["reward_forward"].shape == (6,)
        assert (ages[over] <= 20).all() and (ages[truncated] == 20).all() and (ages[~over] < 20).all()
        for i in np.flatnonzero(over):
            last = info["final_obs"][i]
            z, angle = last[0], last[1]
            assert truncated[i] or not (healthy_z[0] < z < healthy_z[1] and abs(angle) < 1.0)
            assert abs(obs[i, 0] - 1.25) < 0.01 and info["_final_obs"][i]
        fell, cut = fell + terminated.sum(), cut + truncated.sum()
        ages[over] = 0
    assert fell >= 2 and cut >= 2


def test_its_keywords_are_gymnasiums():
    env = gymnasium.make("mjx_walk/Humanoid-v5", physics="c", include_cfrc_ext_in_observation=False)
    assert (
        env.observation_space.shape
        == gymnasium.make("Humanoid-v5", include_cfrc_ext_in_observation=False).observation_space.shape
    )
    assert make_env("humanoid", "c").observation_size == 348 > env.observation_space.shape[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_stable_baselines3_trains_on_it():
    """PPO of another library, with its defaults: episodes get longer and better, on Gymnasium's own task, too."""
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3")
    evaluate_policy = stable_baselines3.common.evaluation.evaluate_policy
    pytest.importorskip("torch").set_num_threads(1)  # several threads wait for each other while another test runs
    env = gymnasium.make("mjx_walk/Walker2d-v5", physics="c")
    model = stable_baselines3.PPO("MlpPolicy", env, seed=0, device="cpu", verbose=0)
    real = stable_baselines3.common.monitor.Monitor(gymnasium.make("Walker2d-v5"))
    before, _ = evaluate_policy(model, real, n_eval_episodes=10)
    model.learn(30_000)
    returns = [episode["r"] for episode in model.ep_info_buffer]
    after, _ = evaluate_policy(model, real, n_eval_episodes=10)
    assert np.mean(returns) > 100 and after > before + 100
