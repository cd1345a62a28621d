"""Automatic resets, episode sums, the pool of starts, and the evaluation that rides along."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import values

from mjx_walk.envs import make_env
from mjx_walk.envs.inline_evaluation import EvaluationConfig, InlineEvaluator
from mjx_walk.envs.vector_env import VectorEnv


def still(task):
    """A policy that does nothing."""
    return lambda params: lambda obs, key: jnp.zeros((obs.shape[0], task.action_size))


def make_vector(task, num_envs, num_eval_envs=2, **kwargs):
    evaluator = InlineEvaluator(
        task, num_envs, EvaluationConfig(num_eval_envs), still(task), steps_per_iteration=num_envs
    )
    return VectorEnv(task, num_envs, evaluator, **kwargs)


def init(env, key):
    """Environments and evaluation, freshly reset."""
    state = env.init(key)
    return state, env.evaluator.init((), state.pool)


def renew(env, state, evaluation, key, iteration):
    """A new pool, and the next round of the evaluation if one has ended."""
    state = env.renew_pool(state, key)
    evaluation, scores = env.evaluator.next_round(evaluation, (), jnp.int32(iteration), state.pool)
    return state, evaluation, scores


@pytest.fixture(scope="module")
def walker():
    return make_env("walker2d", physics="c", max_episode_steps=30)


def test_terminal_observation_is_kept_and_sums_match_a_loop(walker):
    env = make_vector(walker, 3)
    start, evaluation = jax.jit(lambda key: init(env, key))(jax.random.PRNGKey(0))
    state, alone = start, jax.tree.map(lambda x: x[0], start.env)
    action = jnp.ones((3, 6))
    total, length, sums = 0.0, 0, {}
    step, step_alone = jax.jit(env.step), jax.jit(walker.step)
    for _ in range(30):
        alone = step_alone(alone, action[0])
        total += float(alone.reward)
        length += 1
        state, evaluation, outcome, stats = step(state, evaluation, action)
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
    one = make_vector(walker, 1)
    (state, evaluation), stats_sum = jax.jit(lambda key: init(one, key))(jax.random.PRNGKey(0)), {}
    state = state.replace(env=jax.tree.map(lambda x: x[:1], start.env))
    step_one = jax.jit(one.step)
    for _ in range(length):
        state, evaluation, _, stats = step_one(state, evaluation, action[:1])
        stats_sum = {name: stats_sum.get(name, 0.0) + float(value) for name, value in values(stats).items()}
    assert stats_sum["episodes"] == 1 and stats_sum["length"] == length and stats_sum["resets"] == 1
    assert stats_sum["return"] == pytest.approx(total, rel=1e-5)
    terms = sum(stats_sum[name] for name in walker.reward_terms)
    assert terms == pytest.approx(total, rel=1e-5)


def test_truncated_copies_restart_from_different_starts_and_reuse_is_counted(walker):
    env = make_vector(walker, 4)
    state, evaluation = init(env, jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    at_end = walker.options.max_episode_steps - 1
    reused = 0.0
    for round_ in range(2):
        state = state.replace(env=state.env.replace(steps=jnp.full(4, at_end)))
        state, evaluation, _, stats = step(state, evaluation, jnp.zeros((4, 6)))
        stats = values(stats)
        assert stats["resets"] == 4
        assert len(np.unique(np.asarray(state.env.obs), axis=0)) == 4
        reused += float(stats["resets_reused"])
        assert reused == 4 * round_  # the pool holds four: the second round draws them again
    state = env.renew_pool(state, jax.random.PRNGKey(5))
    state = state.replace(env=state.env.replace(steps=jnp.full(4, at_end)))
    assert step(state, evaluation, jnp.zeros((4, 6)))[3]["resets_reused"].value == 0


def test_staggered_first_episodes_are_not_counted(walker):
    env = make_vector(walker, 32, init_at_random_episode_step=True)
    state, evaluation = init(env, jax.random.PRNGKey(0))
    assert len(np.unique(state.env.steps)) > 10
    state = state.replace(env=state.env.replace(steps=jnp.full(32, 29)), started_at_reset=jnp.arange(32) < 3)
    state, _, _, stats = jax.jit(env.step)(state, evaluation, jnp.zeros((32, 6)))
    stats = values(stats)
    assert stats["resets"] == 32 and stats["episodes"] == 3
    assert bool(state.started_at_reset.all())


def test_a_round_of_evaluation_is_not_begun_too_early(walker):
    config = EvaluationConfig(2, every_steps=100)
    env = VectorEnv(walker, 4, InlineEvaluator(walker, 4, config, still(walker), steps_per_iteration=8))
    state, evaluation = init(env, jax.random.PRNGKey(0))
    evaluation = evaluation.replace(alive=jnp.zeros(2, bool))
    for update, is_told in ((11, False), (12, False), (13, True)):
        _, _, scores = renew(env, state, evaluation, jax.random.PRNGKey(1), update)
        assert scores["eval_return"].has_value == is_told


def test_inline_evaluation_equals_an_evaluation_on_its_own(walker):
    """Deterministic episodes in the training batch return what the same episodes return alone."""
    env = make_vector(walker, 3, num_eval_envs=2)
    state, evaluation = init(env, jax.random.PRNGKey(0))
    starts = evaluation.env
    step = jax.jit(env.step)
    for _ in range(30):
        state, evaluation, _, _ = step(state, evaluation, jnp.ones((3, 6)))
    expected = []
    for i in range(2):
        alone, total = jax.tree.map(lambda x, i=i: x[i], starts), 0.0
        for _ in range(30):
            alone = walker.step(alone, jnp.zeros(6))
            total += float(alone.reward)
            if alone.terminated:
                break
        expected.append(total)
    assert not evaluation.alive.any()
    np.testing.assert_allclose(evaluation.returns, expected, rtol=1e-5)
    state, evaluation, scores = renew(env, state, evaluation, jax.random.PRNGKey(1), 7)
    assert scores["eval_return"].value == pytest.approx(np.mean(expected), rel=1e-5)
    assert scores["eval_iteration"].value == 0
    assert evaluation.best_return == scores["eval_return"].value and evaluation.snapshot_iteration == 7
    assert evaluation.alive.all()
    _, _, unfinished = renew(env, state, evaluation, jax.random.PRNGKey(2), 8)
    assert scores["eval_return"].has_value and not unfinished["eval_return"].has_value


def test_the_best_policy_is_the_one_that_was_scored_best(walker):
    evaluator = InlineEvaluator(walker, 2, EvaluationConfig(2), still(walker), steps_per_iteration=1)
    starts = jax.vmap(walker.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    evaluation = evaluator.init(jnp.float32(0.0), starts)
    for update, score in enumerate((1.0, 3.0, 2.0), start=1):
        evaluation = evaluation.replace(alive=jnp.zeros(2, bool), returns=jnp.full(2, score))
        evaluation, _ = evaluator.next_round(evaluation, jnp.float32(update), jnp.int32(update), starts)
    # The second round's is the one that was the present policy when the first one ended.
    assert (float(evaluation.best_policy_params), int(evaluation.best_iteration), float(evaluation.best_return)) == (
        1.0,
        1,
        3.0,
    )
