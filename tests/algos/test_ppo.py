"""PPO: its update equals Brax's, it learns on every engine, and it compiles once."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import acting
from brax.training.agents.ppo import networks as brax_networks
from brax.training.agents.ppo import train as brax_ppo
from brax.training.agents.ppo.losses import PPONetworkParams
from helpers import OPTIMIZED, values
from peers import restore_device_put_replicated
from toy_tasks import BraxSizes, ConstantReward, EndlessReward

from mjx_walk.algos.on_policy import _make_optimizer
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.algos.ppo import PPO, PPOConfig
from mjx_walk.common import networks, returns
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.envs import make_env

SMALL = PPOConfig(
    unroll_length=8,
    normalizer_warmup_steps_per_env=0,
    num_unrolls=1,
    num_minibatches=4,
    num_epochs=3,
    policy_hidden_layer_sizes=(32, 32),
    value_hidden_layer_sizes=(32, 32),
)


def test_ppo_update_equals_brax(monkeypatch):
    """Brax's own trainer, given our initial networks and our transitions, ends at our parameters.

    The shuffle is fixed and the entropy bonus off, since the two draw their keys in another order. No episode
    is cut off in so few steps, which Brax masks and we bootstrap.
    """
    config = dataclasses.replace(SMALL, entropy_coef=0.0, observation_clip=None, init_at_random_episode_step=False)
    task = make_env("walker2d", physics="c")
    algorithm = PPO(task, 32, EvaluationConfig(1), config)
    state, batch = jax.jit(algorithm.collect)(jax.jit(algorithm.init)(jax.random.PRNGKey(0)))

    def fixed_order(key, x, *args, **kwargs):
        return jnp.arange(x) if isinstance(x, int) else x

    monkeypatch.setattr(jax.random, "permutation", fixed_order)
    ours, metrics = jax.jit(algorithm.learn)(state, batch)
    metrics = values(metrics)

    data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch.transitions)  # [T, B, …]
    last = jnp.broadcast_to(data.next_observation, data.observation.shape)
    zeros = jnp.zeros_like(data.reward)
    extras = data.extras | {"state_extras": {"truncation": zeros, "episode_metrics": {}, "episode_done": zeros}}
    data = data._replace(next_observation=last, extras=extras)
    monkeypatch.setattr(acting, "generate_unroll", lambda env, state, *args, **kwargs: (state, data))
    restore_device_put_replicated()
    _, theirs, _ = brax_ppo.train(
        environment=BraxSizes(),
        num_timesteps=32 * 8,
        num_evals=1,
        run_evals=False,
        num_envs=32,
        episode_length=1000,
        unroll_length=config.unroll_length,
        batch_size=32 // config.num_minibatches,
        num_minibatches=config.num_minibatches,
        num_updates_per_batch=config.num_epochs,
        learning_rate=config.learning_rate,
        max_grad_norm=config.max_policy_grad_norm,
        entropy_cost=0.0,
        discounting=config.discount,
        reward_scaling=config.reward_scale,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip_epsilon,
        normalize_observations=True,
        network_factory=lambda *args, **kwargs: brax_networks.make_ppo_networks(
            *args, policy_hidden_layer_sizes=(32, 32), value_hidden_layer_sizes=(32, 32), **kwargs
        ),
        restore_params=(state.normalizer, state.params.policy, state.params.value),
    )
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), ours.params, state.params)
    assert max(jax.tree.leaves(moved)) > 1e-3
    expected = (theirs[0].mean, theirs[0].std, theirs[1], theirs[2])
    found = (ours.normalizer.mean, ours.normalizer.std, ours.params.policy, ours.params.value)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6), found, expected)
    assert all(np.isfinite(value) for name, value in metrics.items() if not name.startswith("eval"))


@pytest.mark.parametrize("physics", ["c", pytest.param("jax", marks=[pytest.mark.slow, pytest.mark.long])])
def test_small_batch_training_learns(physics):
    """Sixteen walkers that are rewarded for standing learn to stand longer."""
    task = make_env("walker2d", physics=physics, forward_reward_weight=0.0)
    config = dataclasses.replace(SMALL, unroll_length=32, num_epochs=8, learning_rate=3e-3, discount=0.95)
    algorithm = PPO(task, 16, EvaluationConfig(2), config)
    state = jax.jit(algorithm.init)(jax.random.PRNGKey(0))
    collect = jax.jit(algorithm.collect, compiler_options=OPTIMIZED if physics == "jax" else None)
    learn = jax.jit(algorithm.learn)
    lengths = []
    for _ in range(14):
        state, metrics = learn(*collect(state))
        metrics = values(metrics)
        lengths.append((float(metrics["length"]), float(metrics["episodes"])))
        assert metrics["nonfinite"] == 0 and metrics["overflow"] == 0
    early, late = np.sum(lengths[:4], axis=0), np.sum(lengths[-4:], axis=0)
    assert late[0] / late[1] > 2.5 * early[0] / early[1]


@pytest.mark.slow
def test_options_train():
    task = make_env("walker2d", physics="c")
    config = dataclasses.replace(
        SMALL,
        normalizer_warmup_steps_per_env=12,
        num_minibatches=2,
        distribution="normal",
        learning_rate_schedule="adaptive_kl",
        normalize_rewards=True,
        max_value_grad_norm=0.5,
        entropy_schedule="linear",
    )
    algorithm = PPO(task, 8, EvaluationConfig(1), config)
    state = jax.jit(algorithm.init)(jax.random.PRNGKey(0))
    collect, learn = jax.jit(algorithm.collect), jax.jit(algorithm.learn)
    for update in range(4):
        before = state.params
        state, metrics = learn(*collect(state))
        is_warmup = update < 2  # of 8 steps each
        assert metrics["loss"].has_value == (not is_warmup)
        if is_warmup:
            jax.tree.map(np.testing.assert_array_equal, before, state.params)
            assert (state.normalizer.std != 1.0).all()
            continue
        metrics = values(metrics)
        assert np.isfinite(metrics["loss"]) and metrics["learning_rate"] > 0
    change = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), before, state.params)
    assert min(jax.tree.leaves(change)) > 0
    action = algorithm.policy(algorithm.policy_params(state), deterministic=False)(
        state.env.env.obs, jax.random.PRNGKey(0)
    )
    assert (jnp.abs(action) <= 1).all()


def test_linear_schedule_has_its_own_horizon():
    task = make_env("walker2d", physics="c")
    horizon = 8 * 8 * 4  # four updates
    config = dataclasses.replace(SMALL, num_minibatches=2, learning_rate_schedule="linear", schedule_steps=horizon)
    algorithm = PPO(task, 8, EvaluationConfig(1), config)
    state, rates = jax.jit(algorithm.init)(jax.random.PRNGKey(0)), []
    collect, learn = jax.jit(algorithm.collect), jax.jit(algorithm.learn)
    for _ in range(5):
        state, metrics = learn(*collect(state))
        metrics = values(metrics)
        rates.append(float(metrics["learning_rate"]) / config.learning_rate)
    np.testing.assert_allclose(rates, [1.0, 0.75, 0.5, 0.25, 0.0], atol=1e-6)


@pytest.mark.parametrize(("task", "lost"), [(EndlessReward(2), 1.0), (ConstantReward(), 0.0)])
def test_a_step_that_is_cut_off_is_paid_the_lost_value_and_one_that_terminates_is_not(task, lost):
    """Rewards are 1; the lost value is γ V(s') in the unscaled units of rewards."""
    config = dataclasses.replace(
        SMALL, unroll_length=4, init_at_random_episode_step=False, reward_scale=0.5, discount=0.9
    )
    algorithm = PPO(task, 4, EvaluationConfig(1), config)
    state = algorithm.init(jax.random.PRNGKey(0))
    value_params = jax.tree.map(lambda x: x + 0.1, state.params.value)  # which are worth nothing at an observation of 0
    state = state.replace(params=state.params.replace(value=value_params))
    _, batch = jax.jit(algorithm.collect)(state)
    value_network = networks.make_ppo_networks(task, config).value_network
    value = float(value_network.apply(state.normalizer, value_params, jnp.zeros((1, 1)))[0])
    ended = np.asarray(batch.transitions.discount) == 0
    assert abs(value) > 0.05 and ended.any()
    np.testing.assert_allclose(batch.transitions.reward, 1.0 + lost * ended * 0.9 * value / 0.5, rtol=1e-4)


def test_the_values_gradient_is_clipped_to_its_own_norm():
    optimizer = _make_optimizer(OnPolicyConfig(max_policy_grad_norm=1.0, max_value_grad_norm=0.25))
    params = PPONetworkParams(policy=jnp.zeros(1), value=jnp.zeros(1))
    _, state = optimizer.update(jax.tree.map(lambda x: x + 8.0, params), optimizer.init(params))
    moments = sorted(float(x[0]) for x in jax.tree.leaves(state) if x.shape == (1,))
    # First moments are a tenth of the clipped gradients, second ones a thousandth of their squares.
    np.testing.assert_allclose(moments, [0.001 * 0.25**2, 0.001, 0.1 * 0.25, 0.1], rtol=1e-3)


def test_the_entropy_bonus_falls_and_rewards_are_normalized_by_what_was_seen_before(monkeypatch):
    """The arguments of Brax's loss, which a fake loss returns as metrics."""

    def loss(params, *_, entropy_cost, reward_scaling, **__):
        names = ("total_loss", "kl_mean", "policy_dist_mean_std")
        zero = jnp.float32(0.0)
        arguments = {"v_loss": jnp.float32(entropy_cost), "policy_loss": jnp.float32(reward_scaling)}
        return zero, dict.fromkeys(names, zero) | arguments

    monkeypatch.setattr("mjx_walk.common.brax_losses.ppo_losses.compute_ppo_loss", loss)
    settings = {
        "unroll_length": 4,
        "num_minibatches": 1,
        "num_epochs": 1,
        "reward_scale": 2.0,
        "normalize_rewards": True,
    }
    schedule = {"entropy_coef": 0.5, "entropy_schedule": "linear", "schedule_steps": 2 * 4 * 4}
    config = dataclasses.replace(SMALL, **settings, **schedule)
    algorithm = PPO(EndlessReward(), 4, EvaluationConfig(1), config)
    state, costs = algorithm.init(jax.random.PRNGKey(0)), []
    collect, learn = jax.jit(algorithm.collect), jax.jit(algorithm.learn)
    for _ in range(3):
        expected = 2.0 * float(returns.reward_multiplier(state.return_scale))
        state, metrics = learn(*collect(state))
        metrics = values(metrics)
        costs.append(float(metrics["value_loss"]))
        assert float(metrics["policy_loss"]) == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(costs, [0.5, 0.25, 0.0])
    assert expected < 1.9  # of returns of up to 8
