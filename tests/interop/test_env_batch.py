"""Many environments in two programs, for trainers that are not written in JAX."""

import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_walk
from mjx_walk.interop.env_batch import EnvBatch
from mjx_walk.utils.errors import UserError

NUM_ENVS = 4


@pytest.fixture(scope="module")
def batch():
    """Hoppers fall after 20 steps or so, and none lives for more than 30."""
    return EnvBatch(mjx_walk.make_env("hopper", "c", max_episode_steps=30), NUM_ENVS)


def actions_of(batch, count):
    shape = (count, NUM_ENVS, batch.task.action_size)
    return np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)


def test_a_step_is_that_of_the_task_and_episodes_start_again(batch):
    step = jax.jit(jax.vmap(batch.task.step))
    state, obs = batch.reset(None, 3)
    np.testing.assert_array_equal(obs, state.env.obs)
    starts, num_truncated, num_terminated = [tuple(row) for row in np.asarray(obs)], 0, 0
    returns, lengths = np.zeros(NUM_ENVS, np.float32), np.zeros(NUM_ENVS, int)
    for action in actions_of(batch, 60):
        expected = step(state.env, action)
        state, result = batch.step(state, action)
        returns, lengths = returns + np.asarray(expected.reward), lengths + 1
        np.testing.assert_array_equal(result.final_obs, expected.obs)
        np.testing.assert_array_equal(result.reward, expected.reward)
        np.testing.assert_array_equal(result.returns, returns)
        np.testing.assert_array_equal(result.lengths, lengths)
        done = np.asarray(expected.terminated | expected.truncated)
        num_terminated, num_truncated = (
            num_terminated + expected.terminated.sum(),
            num_truncated + expected.truncated.sum(),
        )
        np.testing.assert_array_equal(result.obs[~done], expected.obs[~done])
        np.testing.assert_array_equal(state.env.steps, np.where(done, 0, lengths))
        starts += [tuple(row) for row in np.asarray(result.obs)[done]]
        returns[done], lengths[done] = 0, 0
    assert num_terminated > 4 and num_truncated > 0
    assert len(starts) > 3 * NUM_ENVS and len(set(starts)) == len(starts)  # every start is a new one


def test_all_environments_may_end_at_once(batch):
    state, _ = batch.reset(None, 0)
    state = state.replace(starts_used=jnp.int32(NUM_ENVS), env=state.env.replace(steps=jnp.full(NUM_ENVS, 29)))
    state, result = batch.step(state, actions_of(batch, 1)[0])
    assert result.truncated.all() and len(set(map(tuple, np.asarray(result.obs)))) == NUM_ENVS
    assert state.starts_used == NUM_ENVS


def test_a_seed_determines_the_starts(batch):
    (first, a), (_, b), (_, c) = batch.reset(None, 3), batch.reset(None, 3), batch.reset(None, 4)
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    (_, d), (_, e) = batch.reset(first), batch.reset(None)
    assert not np.array_equal(a, d) and not np.array_equal(d, e)


def test_spaces_are_gymnasiums(batch):
    env = gymnasium.make("Hopper-v5")
    assert batch.observation_space("float64") == env.observation_space and batch.action_space() == env.action_space


@pytest.mark.parametrize("num_envs", [0, 2.5, True, "4"])
def test_bad_numbers_are_refused(batch, num_envs):
    with pytest.raises(UserError, match=r"num_envs=.*: must be an integer of at least 1"):
        EnvBatch(batch.task, num_envs)


@pytest.mark.parametrize("seed", [-1, 2**32, 1.5, "a"])
def test_bad_seeds_are_refused(batch, seed):
    with pytest.raises(UserError, match=r"seed=.*: must be an integer from 0 to 4294967295"):
        batch.reset(None, seed)


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [
        ("make_torch_env", "torch", "torch"),
        ("make_sb3_env", "stable_baselines3", "sb3"),
        ("make_rsl_rl_env", "torch", "rsl_rl"),
    ],
)
def test_a_missing_package_is_named(monkeypatch, name, package, extra):
    for module in ("torch_env", "sb3_env", "rsl_rl_env"):
        monkeypatch.delitem(sys.modules, f"mjx_walk.interop.{module}", raising=False)
    for loaded in [package, *sys.modules]:
        if loaded.partition(".")[0] == package:
            monkeypatch.setitem(sys.modules, loaded, None)
    with pytest.raises(UserError, match=rf"^{package} is missing: pip install 'mjx-walk\[{extra}\]'$"):
        getattr(mjx_walk, name)("hopper", 2)
