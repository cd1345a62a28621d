"""The evaluation that rides along in the training batch: its rounds, its scores and the best policy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_walk.common.inline_evaluation import EvaluationConfig, InlineEvaluator
from mjx_walk.envs import make_env
from mjx_walk.envs.vector_env import VectorEnv


def still(task):
    """A policy that does nothing."""
    return lambda params: lambda obs, key: jnp.zeros((obs.shape[0], task.action_size))


def init(env, evaluator, key):
    """Environments and evaluation, freshly reset."""
    state = env.init(key)
    return state, evaluator.init((), state.pool)


def renew(env, evaluator, state, evaluation, key, iteration):
    """A new pool, and the next round of the evaluation if one has ended."""
    state = env.renew_pool(state, key)
    evaluation, scores = evaluator.next_round(evaluation, (), jnp.int32(iteration), state.pool)
    return state, evaluation, scores


@pytest.fixture(scope="module")
def walker():
    return make_env("walker2d", physics="c", max_episode_steps=30)


def test_a_round_of_evaluation_is_not_begun_too_early(walker):
    config = EvaluationConfig(2, every_steps=100)
    env = VectorEnv(walker, 4)
    evaluator = InlineEvaluator(walker, 4, config, still(walker), steps_per_iteration=8)
    state, evaluation = init(env, evaluator, jax.random.PRNGKey(0))
    evaluation = evaluation.replace(alive=jnp.zeros(2, bool))
    for update, is_told in ((11, False), (12, False), (13, True)):
        _, _, scores = renew(env, evaluator, state, evaluation, jax.random.PRNGKey(1), update)
        assert scores["eval_return"].has_value == is_told


def test_inline_evaluation_equals_an_evaluation_on_its_own(walker):
    """Deterministic episodes in the training batch return what the same episodes return alone."""
    env = VectorEnv(walker, 3, random_step_after_falls=True)
    evaluator = InlineEvaluator(walker, 3, EvaluationConfig(2), still(walker), steps_per_iteration=3)
    state, evaluation = init(env, evaluator, jax.random.PRNGKey(0))
    starts = evaluation.env
    assert (state.pool.steps[:2] > 0).all() and (starts.steps == 0).all()
    step = jax.jit(functools.partial(evaluator.step, env))
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
    state, evaluation, scores = renew(env, evaluator, state, evaluation, jax.random.PRNGKey(1), 7)
    assert scores["eval_return"].value == pytest.approx(np.mean(expected), rel=1e-5)
    assert scores["eval_iteration"].value == 0
    assert evaluation.best_return == scores["eval_return"].value and evaluation.snapshot_iteration == 7
    assert evaluation.alive.all()
    _, _, unfinished = renew(env, evaluator, state, evaluation, jax.random.PRNGKey(2), 8)
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
