"""Stable-Baselines3 trains on the Gymnasium environments. It is installed for campaigns only."""

import gymnasium
import pytest
from side_by_side import IDS

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


@pytest.mark.parametrize("workers", ["DummyVecEnv", "SubprocVecEnv"])
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
