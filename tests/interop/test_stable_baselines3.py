"""Stable-Baselines3 trains on the Gymnasium environments. It is installed for campaigns only."""

import inspect
import re

import gymnasium
import numpy as np
import pytest
from helpers import CLONE
from side_by_side import IDS

import mjx_walk
from mjx_walk.utils.errors import UserError

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
stable_baselines3 = pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3")


@pytest.fixture(autouse=True)
def one_thread():
    """Several threads wait for each other while another test runs."""
    pytest.importorskip("torch").set_num_threads(1)


@pytest.mark.parametrize("name", IDS)
def test_its_checker_accepts_every_task(name):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gymnasium.make(f"mjx_walk/{name}", physics="c"))


@pytest.mark.parametrize("workers", [pytest.param("DummyVecEnv", marks=pytest.mark.long), "SubprocVecEnv"])
def test_models_work_in_both_environments(workers, tmp_path):
    """Trained here and continued in Gymnasium's environment, and the other way round."""
    make_vec_env = stable_baselines3.common.env_util.make_vec_env
    vec_env_cls = getattr(stable_baselines3.common.vec_env, workers)
    # The module's name before the colon registers the task in new processes.
    ours = make_vec_env("mjx_walk:mjx_walk/Walker2d-v5", 2, seed=0, vec_env_cls=vec_env_cls)
    real = make_vec_env("Walker2d-v5", 2, seed=0)
    for first, second in ((ours, real), (real, ours)):
        model = stable_baselines3.PPO("MlpPolicy", first, n_steps=32, batch_size=32, device="cpu")
        model.learn(64).save(tmp_path / "model")
        stable_baselines3.PPO.load(tmp_path / "model", env=second, device="cpu").learn(64)
    ours.close()


def test_an_id_suffices():
    stable_baselines3.PPO("MlpPolicy", "mjx_walk/Walker2d-v5", n_steps=32, batch_size=32, device="cpu").learn(32)


@pytest.mark.long
def test_ppo_learns_to_balance():
    """With its defaults, on Gymnasium's own task, too."""
    evaluate_policy = stable_baselines3.common.evaluation.evaluate_policy
    env = gymnasium.make("mjx_walk/InvertedPendulum-v5", physics="c")
    model = stable_baselines3.PPO("MlpPolicy", env, seed=0, device="cpu", verbose=0)
    real = stable_baselines3.common.monitor.Monitor(gymnasium.make("InvertedPendulum-v5"))
    before, _ = evaluate_policy(model, real, n_eval_episodes=10)
    model.learn(4_096)
    after, _ = evaluate_policy(model, real, n_eval_episodes=10)
    assert after > 2 * before


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_it_trains_on_many_environments_and_goes_on_in_gymnasium(algorithm, tmp_path):
    env = mjx_walk.make_sb3_env("walker2d", 8, physics="c")
    settings = {"PPO": {"n_steps": 16, "batch_size": 32}, "SAC": {"learning_starts": 64}}[algorithm]
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, device="cpu", seed=0, **settings).learn(256)
    assert len(model.ep_info_buffer) > 1 and model.ep_info_buffer[0]["l"] > 5
    model.save(tmp_path / "model")
    type(model).load(tmp_path / "model", env=gymnasium.make("Walker2d-v5"), device="cpu").learn(128)


def test_infos_tell_ends_by_the_time_limit_apart():
    env = mjx_walk.make_sb3_env("hopper", 16, physics="c", max_episode_steps=25)
    env.seed(0)
    obs, rng, ends = env.reset(), np.random.default_rng(0), []
    assert obs.dtype == env.observation_space.dtype and obs.shape == (16, 11)
    for _ in range(60):
        obs, _, dones, infos = env.step(rng.uniform(-1, 1, (16, 3)))
        for i in np.flatnonzero(dones):
            assert infos[i]["terminal_observation"].shape == (11,)
            assert not np.array_equal(infos[i]["terminal_observation"], obs[i])
            ends.append((infos[i]["episode"]["l"], infos[i]["TimeLimit.truncated"]))
        assert all("terminal_observation" not in infos[i] for i in np.flatnonzero(~dones))
    assert {is_late for length, is_late in ends if length < 25} == {False}
    assert True in {is_late for length, is_late in ends if length == 25}


def test_a_seed_gives_the_same_episodes():
    first, second = (mjx_walk.make_sb3_env("hopper", 2, physics="c") for _ in range(2))
    first.seed(5)
    second.seed(5)
    start = first.reset()
    np.testing.assert_array_equal(start, second.reset())
    rng, ends = np.random.default_rng(0), 0
    for _ in range(300):
        actions = rng.uniform(-1, 1, (2, 3))
        (obs, _, dones, _), (others, *_) = first.step(actions), second.step(actions)
        np.testing.assert_array_equal(obs, others)
        ends += dones.sum()
    assert ends > 2 and not np.array_equal(first.reset(), start)


def test_its_wrappers_and_callbacks_take_the_environments(tmp_path):
    vec_env = stable_baselines3.common.vec_env
    env = vec_env.VecNormalize(mjx_walk.make_sb3_env("hopper", 4, physics="c"))
    env.seed()  # it draws one below 2**32
    evaluation = vec_env.VecNormalize(mjx_walk.make_sb3_env("hopper", 2, physics="c"), training=False)
    callback = stable_baselines3.common.callbacks.EvalCallback(evaluation, eval_freq=32, log_path=tmp_path, verbose=0)
    stable_baselines3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, device="cpu").learn(256, callback)
    assert len(np.load(tmp_path / "evaluations.npz")["results"]) == 2


def test_a_step_needs_a_reset():
    with pytest.raises(gymnasium.error.ResetNeeded):
        mjx_walk.make_sb3_env("hopper", 2, physics="c").step(np.zeros((2, 3)))


def test_what_belongs_to_one_environment_is_refused():
    env = mjx_walk.make_sb3_env("hopper", 2, physics="c")
    assert env.get_attr("dt") == [0.008] * 2 and env.get_attr("render_mode", 0) == [None]
    with pytest.raises(UserError, match="cannot be set"):
        env.set_attr("dt", 0.1)
    with pytest.raises(UserError, match="cannot be called"):
        env.env_method("render")


@pytest.mark.parametrize(("title", "algorithms"), [("PPO", ["PPO"]), ("SAC and TD3", ["SAC", "TD3"])])
def test_the_page_of_settings_names_its_own(title, algorithms):
    page = (CLONE / "docs" / "from_stable_baselines3.md").read_text()
    section = page.partition(f"## {title}\n")[2].partition("\n## ")[0]
    named = {*re.findall(r"^\| `(\w+)[=`]", section, re.MULTILINE)}
    signatures = [inspect.signature(getattr(stable_baselines3, name)) for name in algorithms]
    known = {name for signature in signatures for name in signature.parameters}
    assert len(named) > 10 and named <= known
