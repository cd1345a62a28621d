"""A2C: its losses worked out from the network's values; correlated noise; a std within bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import values
from toy_tasks import DelayedReward, RewardedAction

from mjx_walk.algos.a2c import A2C, A2CConfig
from mjx_walk.algos.policy_gradient import out_of_bounds, policy_gradient_loss, sampled_kl
from mjx_walk.common import networks
from mjx_walk.common.exploration import OrnsteinUhlenbeck
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.utils.errors import UserError

NUM_ENVS, STEPS = 16, 6
GAUSSIAN = {"distribution": "normal", "policy_hidden_layer_sizes": (8,), "value_hidden_layer_sizes": (8,)}


def collected(task, **changes):
    """Config, algorithm, state and batch after one `collect`."""
    config = A2CConfig(unroll_length=STEPS, normalizer_warmup_steps_per_env=0, reward_scale=2.0, **GAUSSIAN, **changes)
    algorithm = A2C(task, NUM_ENVS, EvaluationConfig(1), config)
    before = jax.jit(algorithm.init)(jax.random.PRNGKey(0))
    return config, algorithm, *jax.jit(algorithm.collect)(before)


@pytest.mark.parametrize("gae_lambda", [0.0, 0.9])
def test_losses(gae_lambda):
    """With λ = 0 the advantage is the one-step temporal difference; with another one it follows from these."""
    config, algorithm, state, batch = collected(
        DelayedReward(), gae_lambda=gae_lambda, discount=0.5, normalize_advantages=False
    )
    after, metrics = jax.jit(algorithm.learn)(state, batch)
    metrics = values(metrics)
    steps, nets = batch.transitions, networks.make_ppo_networks(DelayedReward(), config)
    obs = jnp.concatenate([steps.observation, steps.next_observation], axis=1)
    predicted = np.asarray(nets.value_network.apply(state.normalizer, state.params.value, obs))
    assert {0.0, 1.0} == set(np.asarray(steps.discount).ravel())
    error = 2.0 * steps.reward + 0.5 * steps.discount * predicted[:, 1:] - predicted[:, :-1]
    advantage, following = np.zeros_like(error), np.zeros(NUM_ENVS)
    for t in reversed(range(STEPS)):
        following = error[:, t] + 0.5 * gae_lambda * steps.discount[:, t] * following
        advantage[:, t] = following
    mean, std = map(np.asarray, nets.policy_network.apply(state.normalizer, state.params.policy, steps.observation))
    action = np.asarray(steps.extras["policy_extras"]["raw_action"])
    log_prob = (-0.5 * ((action - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)).sum(axis=-1)
    assert metrics["value_loss"] == pytest.approx(np.square(advantage).mean(), rel=1e-4)
    assert metrics["policy_loss"] == pytest.approx(-(advantage * log_prob).mean(), rel=1e-3)
    assert not np.array_equal(jax.tree.leaves(after.params)[0], jax.tree.leaves(state.params)[0])


def test_the_loss_is_the_sum_of_its_parts_and_rewards_entropy():
    config, algorithm, state, batch = collected(RewardedAction(), entropy_coef=0.3)
    _, metrics = jax.jit(algorithm.learn)(state, batch)
    metrics = values(metrics)
    losses = metrics["policy_loss"] + config.value_loss_coef * metrics["value_loss"] + metrics["mean_out_of_bounds"]
    assert abs(float(metrics["entropy"])) > 0.1
    assert float(metrics["loss"]) == pytest.approx(float(losses - 0.3 * metrics["entropy"]), rel=1e-4)


def test_correlated_noise_reaches_the_environment():
    """The policy acts 0 with almost no noise of its own, so the last reward shows the correlated noise."""
    _, _, state, batch = collected(RewardedAction(), init_noise_std=1e-6, ou_noise_std=0.2)
    assert state.exploration.shape == (NUM_ENVS, 1) and np.asarray(state.exploration).std() > 0.1
    acted = jnp.clip(state.exploration[:, 0], -1.0, 1.0)
    np.testing.assert_allclose(batch.transitions.reward[:, -1], -jnp.square(acted - 0.5), atol=1e-2)


def test_ornstein_uhlenbeck_statistics():
    noise = OrnsteinUhlenbeck(std=0.1, theta=0.15)
    path = np.asarray(noise.sequence(noise.init(256, 2), jax.random.PRNGKey(0), 400))[100:]
    assert path.std() == pytest.approx(0.1 / np.sqrt(1 - 0.85**2), rel=0.05)
    assert (path[1:] * path[:-1]).mean() / path.var() == pytest.approx(0.85, abs=0.01)


@pytest.mark.parametrize("state_dependent", [False, True])
def test_std_stays_within_its_bounds(state_dependent):
    config = A2CConfig(min_log_std=-1.0, max_log_std=0.5, state_dependent_std=state_dependent, **GAUSSIAN)
    nets = networks.make_ppo_networks(RewardedAction(), config)
    for std, bounded in ((1e30, np.exp(0.5)), (1.2, 1.2), (0.0, np.exp(-1.0))):
        parameters = (jnp.zeros((4096, 1)), jnp.full((4096, 1), std))
        drawn = nets.parametric_action_distribution.sample(parameters, jax.random.PRNGKey(0))
        assert np.asarray(drawn).std() == pytest.approx(bounded, rel=0.05)
    _, std = nets.policy_network.apply(
        networks.init_normalizer(1), nets.policy_network.init(jax.random.PRNGKey(0)), jnp.float32([[-3.0], [3.0]])
    )
    assert (float(std[0, 0]) != float(std[1, 0])) is state_dependent


def test_sampled_kl_is_that_of_two_gaussians():
    """KL(N(0, 1) ‖ N(0.3, 1)) = 0.3² / 2, from draws of the first."""
    drawn = jax.random.normal(jax.random.PRNGKey(0), (200_000,))
    acted, learned = -0.5 * drawn**2, -0.5 * (drawn - 0.3) ** 2
    assert float(sampled_kl(learned, acted)) == pytest.approx(0.045, rel=0.02)
    assert float(sampled_kl(acted, acted)) == 0.0


def test_adaptive_rate_needs_several_minibatches():
    with pytest.raises(UserError, match=r"needs algo\.num_minibatches of 2 or more"):
        collected(RewardedAction(), learning_rate_schedule="adaptive_kl")


def test_adaptive_rate_follows_how_far_the_policy_moves():
    settings = {"learning_rate_schedule": "adaptive_kl", "num_minibatches": 8, "learning_rate": 1e-2}
    _, algorithm, state, batch = collected(RewardedAction(), target_kl=1e-5, **settings)
    after, metrics = jax.jit(algorithm.learn)(state, batch)
    metrics = values(metrics)
    assert float(after.learning_rate) == pytest.approx(1e-2 / 1.5, rel=1e-5) and metrics["kl"] > 2e-5
    _, algorithm, state, batch = collected(RewardedAction(), target_kl=10.0, **settings | {"learning_rate": 1e-4})
    after, _ = jax.jit(algorithm.learn)(state, batch)
    assert float(after.learning_rate) == pytest.approx(1e-4 * 1.5, rel=1e-5)


def test_policy_gradient_is_plain_at_first_and_lets_go_of_what_has_become_unlikely():
    acted, advantages = jnp.float32([-1.0, -1.0, -2.0]), jnp.float32([0.5, -3.0, 1.0])
    gradient = jax.grad(lambda log_prob: policy_gradient_loss(log_prob, acted, advantages).sum())
    np.testing.assert_allclose(gradient(acted), -advantages)
    np.testing.assert_allclose(gradient(acted - 30.0), 0.0, atol=1e-12)
    np.testing.assert_allclose(gradient(acted + 1.0), -jnp.e * advantages, rtol=1e-6)
    np.testing.assert_allclose(gradient(acted + 1e6), -10.0 * advantages)


def test_means_are_pulled_back_into_the_bounds_of_actions():
    mean = jnp.float32([[1.5, -0.5], [-3.0, 2.0]])
    assert float(out_of_bounds(mean)) == pytest.approx((0.25 + 4.0 + 1.0) / 2)
    np.testing.assert_allclose(jax.grad(out_of_bounds)(mean), [[0.5, 0.0], [-2.0, 1.0]])
