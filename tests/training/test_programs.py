"""Programs of one run, of seeds and of devices: what the trainer asks of each of them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_tasks import ObservedReward

from mjx_walk.algos.ppo import PPO, PPOConfig
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.training.distributed import Processes
from mjx_walk.training.programs import DevicesProgram, SeedsProgram, SingleProgram
from mjx_walk.utils.collectives import DEVICES

KEYS = [jax.random.PRNGKey(seed) for seed in (3, 5)]
ITERATIONS = 2


@functools.cache
def algorithm(axis_name=None):
    config = PPOConfig(unroll_length=4, num_unrolls=1, num_minibatches=1, normalizer_warmup_steps_per_env=0)
    return PPO(ObservedReward(), 8, EvaluationConfig(1), config, axis_name=axis_name)


@functools.cache
def program(kind):
    if kind is DevicesProgram:
        return DevicesProgram(algorithm(DEVICES), ITERATIONS, Processes())
    return kind(algorithm(), ITERATIONS, fused=kind is SeedsProgram)


def assert_equal(tree, other):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(tree), jax.device_get(other))


def assert_close(tree, other):
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), tree, other)


@pytest.mark.parametrize(("kind", "num_runs"), [(SingleProgram, 1), (SeedsProgram, 2), (DevicesProgram, 1)])
def test_a_program_answers_for_each_of_its_runs(kind, num_runs):
    """Its parts are states and metrics of a single run, and make up its state again."""
    state = program(kind).init(KEYS[:num_runs])
    parts = program(kind).split(state)
    assert len(parts) == num_runs
    assert jax.tree.map(jnp.shape, parts[0]) == jax.tree.map(jnp.shape, algorithm().state_shapes())
    assert_equal(program(kind).merge(parts), state)
    assert_equal(program(kind).split(algorithm().policy_params(state))[-1], algorithm().policy_params(parts[-1]))
    parts = jax.tree.map(jnp.array, parts)  # the step consumes the state
    after, metrics = program(kind).run_call(state)
    for part, new, own in zip(parts, program(kind).split(after), metrics, strict=True):
        alone, (alone_metrics,) = program(SingleProgram).run_call(part)
        assert_close(jax.device_get(new), jax.device_get(alone))
        assert own["loss"].value.shape == (ITERATIONS,)
        assert_close(own, alone_metrics)


@pytest.mark.parametrize(("kind", "num_runs"), [(SingleProgram, 1), (SeedsProgram, 2), (DevicesProgram, 1)])
def test_a_program_names_the_runs_that_are_not_finite(kind, num_runs):
    state = program(kind).init(KEYS[:num_runs])
    assert program(kind).is_finite(state).tolist() == [True] * num_runs
    *finite, last = program(kind).split(state)
    broken = last.replace(params=jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), last.params))
    state = program(kind).merge([*finite, broken])
    assert program(kind).is_finite(state).tolist() == [True] * (num_runs - 1) + [False]


def test_a_program_compiles_ahead_what_it_calls():
    """A restored run needs no `init`."""
    state = program(SeedsProgram).init(KEYS)
    assert len(program(SingleProgram).lower(KEYS[:1], None)) == 3
    assert len(program(SeedsProgram).lower(KEYS, None)) == 2
    assert len(program(SeedsProgram).lower(KEYS, state)) == 1
    assert len(program(DevicesProgram).lower(KEYS[:1], None)) == 1
