"""Training on gymnax's environments. They are installed for campaigns only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.fast import Fast
from helpers import unregistered

import mjx_walk
from mjx_walk.envs import TASKS
from mjx_walk.utils.errors import UserError

gymnax = pytest.importorskip("gymnax", reason="docs/adapters.md says how to install it")
purerl = pytest.importorskip("gymnax.wrappers.purerl")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


def make(name, **options):
    """The task of an environment, and the environment."""
    env, params = gymnax.make(name)
    with unregistered():
        mjx_walk.register_task("own", mjx_walk.from_gymnax(env, params))
        kind, schema = TASKS["own"]
        return kind(schema(**options)), env, params


def test_each_step_is_gymnaxs():
    task, env, params = make("Pendulum-v1")
    key, reset_key = jax.random.split(jax.random.PRNGKey(0))
    state, (obs, own) = task.reset(jax.random.PRNGKey(0)), env.reset_env(reset_key, params)
    assert (task.max_episode_steps, task.observation_size, task.action_low, task.action_high) == (200, 3, -2.0, 2.0)
    step = jax.jit(task.step)
    for number in range(200):
        np.testing.assert_allclose(state.obs, obs, rtol=1e-4, atol=1e-4)
        key, step_key = jax.random.split(key)
        action = jnp.sin(jnp.float32([number]))
        state = step(state, action)
        obs, own, reward, *_ = env.step_env(step_key, own, action, params)
        assert state.reward == pytest.approx(float(reward), rel=1e-4, abs=1e-4)
        assert state.truncated == (number == 199) and not state.terminated


def test_the_goal_terminates_and_the_time_limit_truncates():
    task, *_ = make("MountainCarContinuous-v0", max_episode_steps=300)

    def play(push):
        def step(state, _):
            velocity = state.obs[1]
            action = jnp.where(velocity >= 0, push, -push)[None]
            state = task.step(state, action)
            return state, (state.terminated, state.truncated)

        return jax.lax.scan(step, task.reset(jax.random.PRNGKey(0)), length=300)[1]

    terminated, truncated = jax.jit(play)(1.0)
    assert terminated.any() and not truncated[:-1].any()
    terminated, truncated = jax.jit(play)(0.0)
    assert not terminated.any() and truncated[-1]


def test_ppo_learns_to_swing_up(tmp_path, monkeypatch):
    """Random policies get about -1,200."""
    settings = (
        "num_envs=64",
        "total_steps=45_000",
        "algo.schedule_steps=45_000",
        "algo.discount=0.95",
        "algo.learning_rate=1e-3",
    )
    settings += ("evaluation.gymnasium_episodes=2", "evaluation.num_envs=16", f"run_dir={tmp_path / 'run'}")
    monkeypatch.setattr("mjx_walk.viewing.run_plots.plot_run", lambda folder: None)
    with unregistered():
        run = mjx_walk.run(["algo=ppo", *settings], task=mjx_walk.from_gymnax(*gymnax.make("Pendulum-v1")))
        assert run.config.env.name == "gymnax_pendulum"
        assert run.evaluate(20).returns.mean() > -500


def test_other_objects_are_refused():
    with pytest.raises(UserError, match=r"CartPole-v1 has discrete actions; .* Pendulum-v1"):
        mjx_walk.from_gymnax(*gymnax.make("CartPole-v1"))
    with pytest.raises(UserError, match=r"Fast has no reset_env and step_env of its own; .* mjx_walk.from_brax"):
        mjx_walk.from_gymnax(Fast())
    with pytest.raises(UserError, match="LogWrapper has no reset_env"):
        mjx_walk.from_gymnax(purerl.LogWrapper(gymnax.make("Pendulum-v1")[0]))
