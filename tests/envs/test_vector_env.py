"""Automatic resets, episode sums and the pool of starts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import values

from mjx_walk.envs import make_env
from mjx_walk.envs.vector_env import VectorEnv


def init(env, key):
    """Environments that train, freshly reset, and two others."""
    state = env.init(key)
    return state, jax.tree.map(lambda x: x[:2], state.pool)


def step_all(env):
    """Compile a step in which the others do nothing."""
    still = jnp.zeros((2, env.task.action_size))
    return jax.jit(lambda state, others, action: env.step(state, action, others, still))


@pytest.fixture(scope="module")
def walker():
    return make_env("walker2d", physics="c", max_episode_steps=30)


def test_terminal_observation_is_kept_and_sums_match_a_loop(walker):
    env = VectorEnv(walker, 3)
    start, others = jax.jit(lambda key: init(env, key))(jax.random.PRNGKey(0))
    state, alone = start, jax.tree.map(lambda x: x[0], start.env)
    action = jnp.ones((3, 6))
    total, length, sums = 0.0, 0, {}
    step, step_alone = step_all(env), jax.jit(walker.step)
    for _ in range(30):
        alone = step_alone(alone, action[0])
        total += float(alone.reward)
        length += 1
        state, others, outcome, stats = step(state, others, action)
        np.testing.assert_allclose(outcome.obs[0], alone.obs, rtol=1e-6)  # also at the end: not the reset's
        for name, value in stats.items():
            sums[name] = sums.get(name, 0.0) + float(value.value)
        if alone.terminated or alone.truncated:
            break
    assert bool(outcome.terminated[0] | outcome.truncated[0])
    assert state.env.steps[0] == 0 and state.sums.reward[0] == 0
    assert np.abs(state.env.obs[0] - alone.obs).max() > 0.1
    in_pool = (state.pool.obs == state.env.obs[0]).all(axis=1)
    assert in_pool.any()
    one = VectorEnv(walker, 1)
    state, stats_sum = jax.jit(one.init)(jax.random.PRNGKey(0)), {}
    state = state.replace(env=jax.tree.map(lambda x: x[:1], start.env))
    step_one = step_all(one)
    for _ in range(length):
        state, others, _, stats = step_one(state, others, action[:1])
        stats_sum = {name: stats_sum.get(name, 0.0) + float(value) for name, value in values(stats).items()}
    assert stats_sum["episodes"] == 1 and stats_sum["length"] == length and stats_sum["resets"] == 1
    assert stats_sum["return"] == pytest.approx(total, rel=1e-5)
    terms = sum(stats_sum[name] for name in walker.reward_terms)
    assert terms == pytest.approx(total, rel=1e-5)


def test_truncated_copies_restart_from_different_starts_and_reuse_is_counted(walker):
    env = VectorEnv(walker, 4)
    state, others = init(env, jax.random.PRNGKey(0))
    step = step_all(env)
    at_end = walker.options.max_episode_steps - 1
    reused = 0.0
    for round_ in range(2):
        state = state.replace(env=state.env.replace(steps=jnp.full(4, at_end)))
        state, others, _, stats = step(state, others, jnp.zeros((4, 6)))
        stats = values(stats)
        assert stats["resets"] == 4
        assert len(np.unique(np.asarray(state.env.obs), axis=0)) == 4
        reused += float(stats["resets_reused"])
        assert reused == 4 * round_  # the pool holds four: the second round draws them again
    state = env.renew_pool(state, jax.random.PRNGKey(5))
    state = state.replace(env=state.env.replace(steps=jnp.full(4, at_end)))
    assert step(state, others, jnp.zeros((4, 6)))[3]["resets_reused"].value == 0


def test_every_second_episode_after_a_fall_starts_at_a_random_step_count(walker):
    env = VectorEnv(walker, 64, random_step_after_falls=True)
    state, others = init(env, jax.random.PRNGKey(0))
    qpos = state.env.physics.qpos
    lying = state.env.physics._replace(qpos=qpos.at[:32, 1].set(0.3))  # the first half falls, the others time out
    state = state.replace(
        env=state.env.replace(physics=lying, steps=jnp.where(jnp.arange(64) < 32, 0, 29)),
        started_at_reset=jnp.ones(64, bool),
    )
    step, still = step_all(env), jnp.zeros((64, 6))
    state, others, outcome, stats = step(state, others, still)
    np.testing.assert_array_equal(outcome.terminated, np.arange(64) < 32)
    assert len(np.unique(state.env.steps[:32])) > 10 and (state.env.steps[32:] == 0).all()
    assert (state.env.steps < 30).all()
    np.testing.assert_array_equal(state.started_at_reset, state.env.steps == 0)
    assert values(stats)["episodes"] == 64

    lying = state.env.physics._replace(qpos=state.env.physics.qpos.at[:32, 1].set(0.3))
    next_state, _, outcome, stats = step(state.replace(env=state.env.replace(physics=lying)), others, still)
    assert (next_state.env.steps[:32] == 0)[state.env.steps[:32] > 0].all()
    assert values(stats)["episodes"] == (state.env.steps[:32] == 0).sum()


def test_no_episode_starts_at_a_random_step_count_unless_asked(walker):
    env = VectorEnv(walker, 64, init_at_random_episode_step=True)
    state, others = init(env, jax.random.PRNGKey(0))
    lying = state.env.physics._replace(qpos=state.env.physics.qpos.at[:, 1].set(0.3))
    state = state.replace(env=state.env.replace(physics=lying))
    state, _, outcome, _ = step_all(env)(state, others, jnp.zeros((64, 6)))
    assert outcome.terminated.all() and (state.env.steps == 0).all() and state.started_at_reset.all()


def test_staggered_first_episodes_are_not_counted(walker):
    env = VectorEnv(walker, 32, init_at_random_episode_step=True)
    state, others = init(env, jax.random.PRNGKey(0))
    assert len(np.unique(state.env.steps)) > 10
    state = state.replace(env=state.env.replace(steps=jnp.full(32, 29)), started_at_reset=jnp.arange(32) < 3)
    state, _, _, stats = step_all(env)(state, others, jnp.zeros((32, 6)))
    stats = values(stats)
    assert stats["resets"] == 32 and stats["episodes"] == 3
    assert bool(state.started_at_reset.all())
