"""REINFORCE: its loss worked out by hand, over the steps that it is to learn from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import values
from toy_tasks import DelayedReward, EndlessReward

from mjx_walk.algos.reinforce import REINFORCE, REINFORCEConfig, linear_fit
from mjx_walk.common import networks
from mjx_walk.common.inline_evaluation import EvaluationConfig

NUM_ENVS, STEPS, LEARNED = 16, 6, 4
# The tail beyond the unroll has discount 0.5³ at the fourth step and 0.5² at the fifth.
SETTINGS = {
    "unroll_length": STEPS,
    "normalizer_warmup_steps_per_env": 0,
    "discount": 0.5,
    "max_tail_discount": 0.2,
    "baseline": "mean",
    "policy_hidden_layer_sizes": (8,),
}


def learned(task, **changes):
    """Config, state, batch and metrics of one update."""
    config = REINFORCEConfig(**SETTINGS, **changes)
    algorithm = REINFORCE(task, NUM_ENVS, EvaluationConfig(1), config)
    state, batch = jax.jit(algorithm.collect)(jax.jit(algorithm.init)(jax.random.PRNGKey(0)))
    return config, state, batch, values(jax.jit(algorithm.learn)(state, batch)[1])


def test_loss_over_the_steps_whose_future_was_seen():
    """The last steps of an unroll are left out, even if their episode ends there."""
    config, state, batch, metrics = learned(DelayedReward(), init_at_random_episode_step=False)
    steps, nets = batch.transitions, networks.make_ppo_networks(DelayedReward(), config)
    assert (np.asarray(steps.discount)[:, LEARNED:] == 0.0).any()
    obs = np.asarray(steps.observation)[:, :LEARNED]
    return_to_go = np.where(obs[..., 0] == 1.0, 1.0, 0.5)
    advantage = (return_to_go - return_to_go.mean()) / return_to_go.std()
    mean, std = map(np.asarray, nets.policy_network.apply(state.normalizer, state.params.policy, obs))
    action = np.asarray(steps.extras["policy_extras"]["raw_action"])[:, :LEARNED]
    log_prob = (-0.5 * ((action - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)).sum(axis=-1)
    assert metrics["policy_loss"] == pytest.approx(-(advantage * log_prob).mean(), rel=1e-3)
    assert metrics["learned_from"] == pytest.approx(LEARNED / STEPS)


def test_steps_just_before_a_time_limit_are_left_out():
    """With a limit of six steps and random first episode steps, four of six steps count anywhere in an unroll."""
    _, _, batch, metrics = learned(EndlessReward(6))
    cut = np.asarray(batch.transitions.extras["state_extras"]["truncation"]) > 0.0
    seen = np.ones((NUM_ENVS, LEARNED), bool)
    for t in range(LEARNED):
        seen[:, t] = ~cut[:, t : t + 2].any(axis=1)  # at two steps from the cut, the future counts 0.25
    assert 0 < seen.sum() < seen.size
    assert metrics["learned_from"] == pytest.approx(seen.sum() / (NUM_ENVS * STEPS))


def test_linear_baseline_is_the_least_squares_fit():
    """Of what counts; what does not may be anything."""
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    obs, noise = jax.random.normal(keys[0], (64, 8, 3)), jax.random.normal(keys[1], (64, 8))
    weight = jnp.float32(jax.random.bernoulli(keys[2], 0.7, (64, 8)))
    target = obs @ jnp.float32([0.6, -0.6, 0.0]) + 0.1 * (jnp.square(obs[..., 2]) - 1.0) + 0.5 * noise
    target -= (weight * target).sum() / weight.sum()
    fitted = np.asarray(linear_fit(obs, jnp.where(weight, target, 1e3), weight))
    features = np.concatenate([obs, np.square(obs), np.ones((64, 8, 1))], axis=-1)
    counts = np.asarray(weight) > 0
    exact = features @ np.linalg.lstsq(features[counts], np.asarray(target)[counts], rcond=None)[0]
    np.testing.assert_allclose(fitted[counts], exact[counts], atol=0.1)
    assert np.std(np.asarray(target)[counts] - fitted[counts]) == pytest.approx(0.5, abs=0.05)


def test_linear_baseline_bears_observations_that_say_the_same():
    """Constants, duplicates, and the scales of the humanoid's first observations."""
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    varied = jax.random.normal(keys[0], (64, 64, 20)) * jnp.logspace(-3, 2, 20)
    obs = jnp.concatenate([varied, varied, 3.0 * varied, jnp.full((64, 64, 100), 8.3), jnp.zeros((64, 64, 160))], -1)
    target = varied[..., 10] / varied[..., 10].std() + 0.1 * jax.random.normal(keys[1], (64, 64))
    fitted = linear_fit(obs, target - target.mean(), jnp.ones((64, 64)))
    assert np.std(target - target.mean() - fitted) == pytest.approx(0.1, abs=0.03)
