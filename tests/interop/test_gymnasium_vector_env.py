"""Many environments in one program, compared with Gymnasium's `SyncVectorEnv`."""

import copy
import pickle

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from helpers import renders, slow_except
from side_by_side import assert_same, make_and_reset, make_both

from mjx_walk.envs import NO_TIME_LIMIT
from mjx_walk.utils.errors import UserError


@pytest.mark.parametrize("physics", slow_except(["c"], ["c", "jax"]))
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


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("name", ["Walker2d-v5", "Humanoid-v4"])
def test_every_mode_of_resets_is_gymnasiums(name, mode):
    """Through falls and time limits: observations, rewards, flags, info with its masks, and final observations."""
    keywords = {"num_envs": 3, "max_episode_steps": 25, "reset_noise_scale": 0.0}
    own = {"autoreset_mode": mode}
    ours, real = make_both(name, gymnasium.make_vec, own, {"vector_kwargs": own}, **keywords)
    assert ours.metadata == real.metadata and ours.observation_space == real.observation_space
    assert_same(ours.reset(seed=[1, 2, 3]), real.reset(seed=[1, 2, 3]))
    rng, terminated, truncated = np.random.default_rng(0), 0, 0
    for _ in range(60):
        action = rng.uniform(-1, 1, ours.action_space.shape) * ours.action_space.high
        found, expected = ours.step(action), real.step(action)
        assert_same(found, expected, atol=0.05)
        terminated, truncated = terminated + found[2].sum(), truncated + found[3].sum()
        is_over = found[2] | found[3]
        if mode == AutoresetMode.DISABLED and is_over.any():
            with pytest.raises(AssertionError):  # Gymnasium's raises it too, but first steps some environments
                ours.step(action)
            masks = [{"reset_mask": is_over.copy()} for _ in range(2)]
            assert_same(ours.reset(options=masks[0]), real.reset(options=masks[1]), atol=0.05)
    assert terminated and truncated


@pytest.mark.parametrize(("given", "limit"), [(-1, NO_TIME_LIMIT), (None, 1000), (7, 7)])
def test_a_time_limit_means_what_it_means_in_gymnasium(given, limit):
    name = "mjx_walk/InvertedPendulum-v5"
    made = gymnasium.make_vec(name, num_envs=2, physics="c", max_episode_steps=given)
    assert made._options.max_episode_steps == limit


def test_an_environment_depends_on_its_own_seed():
    envs = gymnasium.make_vec("mjx_walk/Walker2d-v5", num_envs=3, physics="c")
    first, _ = envs.reset(seed=[7, 8, 9])
    assert envs.np_random_seed == (7, 8, 9)
    np.testing.assert_array_equal(envs.reset(seed=[9, 7, None])[0][:2], first[[2, 0]])
    np.testing.assert_array_equal(envs.reset(seed=7)[0], first)
    for seeds in ([1, 2], [1, 2, 3, 4]):
        with pytest.raises(ValueError, match="num_envs=3"):
            envs.reset(seed=seeds)
    mask = np.array([False, True, False])
    obs, info = envs.reset(seed=[1, 7, 1], options={"reset_mask": mask})
    np.testing.assert_array_equal(obs, first[[0, 0, 2]])
    np.testing.assert_array_equal(info["_x_position"], mask)
    for wrong, error in (([True] * 3, TypeError), (np.ones(2, bool), ValueError), (np.zeros(3, bool), ValueError)):
        with pytest.raises(error, match="reset_mask"):
            envs.reset(options={"reset_mask": wrong})


def test_wrong_actions_and_keywords_raise():
    envs = gymnasium.make_vec("mjx_walk/Walker2d-v5", num_envs=2, physics="c")
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((2, 6)))
    envs.reset()
    for action in (0.0, np.zeros(2), np.zeros((2, 1)), np.zeros((1, 6)), np.zeros(12)):
        with pytest.raises(ValueError, match="Action dimension mismatch"):
            envs.step(action)
    for mode, says in (("human", "'human' shows one environment"), ("rgb_array_list", "collects the frames of one")):
        with pytest.raises(UserError, match=says):
            gymnasium.make_vec("mjx_walk/Walker2d-v5", num_envs=2, render_mode=mode)


@pytest.mark.parametrize("prng", ["rbg", "unsafe_rbg"])
def test_other_random_generators_of_jax_are_refused(prng):
    refused = rf"^JAX_DEFAULT_PRNG_IMPL={prng}: make_vec needs threefry2x32; unset it$"
    with jax.default_prng_impl(prng), pytest.raises(UserError, match=refused):
        gymnasium.make_vec("mjx_walk/Walker2d-v5", num_envs=2, physics="c")


def test_copies_and_attributes():
    envs = gymnasium.make_vec("mjx_walk/Walker2d-v5", num_envs=2, physics="c")
    envs.reset(seed=0)
    action = np.full((2, 6), 0.5)
    _, reward, terminated, *_ = envs.step(action)
    reward[~terminated] -= 1.0  # every array is the caller's
    copies = [copy.deepcopy(envs), pickle.loads(pickle.dumps(envs))]
    expected = envs.step(action)
    for other in copies:
        assert_same(other.step(action), expected, atol=0)
    assert envs.get_attr("dt") == (0.008, 0.008) and envs.call("get_body_com", "foot")[1].shape == (3,)
    envs.set_attr("note", ["a", "b"])
    assert envs.get_attr("note") == ("a", "b")
    with pytest.raises(ValueError, match="`3` values for 2 environments"):
        envs.set_attr("note", [1, 2, 3])
    before = envs.call("state_vector")
    envs.envs[1].set_state(*np.split(before[0] + 0.5, 2))
    np.testing.assert_array_equal(envs.call("state_vector"), np.float32([before[0], before[0] + 0.5]))


def test_entries_have_the_dtypes_of_gymnasium():
    """Among them an integer: the reward of a pendulum."""
    ours, real = make_both("InvertedPendulum-v5", gymnasium.make_vec, num_envs=2, reset_noise_scale=0.0)
    for env in (ours, real):
        env.reset()
    found, expected = (env.step(np.zeros((2, 1))) for env in (ours, real))
    assert_same(found, expected)
    assert found[4]["reward_survive"].dtype == expected[4]["reward_survive"].dtype == np.int64


@renders
def test_frames():
    envs = gymnasium.make_vec("mjx_walk/Walker2d-v5", num_envs=2, render_mode="rgb_array", width=64, height=48)
    envs.reset(seed=0)
    first, second = envs.render()
    assert first.shape == (48, 64, 3) and first.std() > 0 and (first != second).any()
    envs.close()


@pytest.mark.slow
@pytest.mark.parametrize("context", ["spawn", "forkserver", None])
def test_workers(context):
    """Forked ones, the default on Linux before Python 3.14, cannot use JAX and say so in the first step."""
    envs = AsyncVectorEnv([make_and_reset] * 2, context=context)
    obs, _ = envs.reset(seed=3)
    expected, _ = gymnasium.make("Walker2d-v5").reset(seed=3)
    np.testing.assert_allclose(obs[0], expected, atol=1e-6)
    if context is None:
        with pytest.raises(gymnasium.error.Error, match=r"vector_kwargs={'context': 'spawn'}"):
            envs.step(envs.action_space.sample())
        return
    envs.step(envs.action_space.sample())
    envs.close()


def test_what_gymnasiums_own_vector_environment_allows_before_the_first_reset():
    ours = gymnasium.make_vec("mjx_walk/Hopper-v5", num_envs=3)
    theirs = gymnasium.make_vec("Hopper-v5", num_envs=3)
    for envs in (ours, theirs):
        seeds = envs.np_random_seed
        assert len(seeds) == 3 and all(isinstance(seed, int) for seed in seeds)
        obs, _ = envs.reset(options={"reset_mask": np.ones(3, np.bool_)})
        assert obs.shape == (3, 11)
    assert ours.np_random_seed == ours.get_attr("np_random_seed")


def test_sub_environments_have_the_attributes_of_an_unwrapped_environment():
    for name in ("mjx_walk/Hopper-v5", "Hopper-v5"):
        envs = gymnasium.make_vec(name, num_envs=2)
        assert envs.call("get_wrapper_attr", "dt") == (0.008, 0.008)
        assert envs.call("has_wrapper_attr", "nothing") == (False, False)
        assert envs.call("set_wrapper_attr", "note", 7) == (True, True) and envs.get_attr("note") == (7, 7)
        assert [env.frame_skip for env in envs.get_attr("unwrapped")] == [4, 4]
