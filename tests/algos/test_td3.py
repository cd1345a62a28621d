"""TD3 and DDPG: targets and updates worked out by hand on linear networks."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from toy_tasks import ToyTask

from mjx_walk.algos.ddpg import DDPG, DDPGConfig
from mjx_walk.algos.off_policy_state import Batch
from mjx_walk.algos.td3 import TD3, TD3Config
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.utils.types import Transition

LINEAR = {
    "policy_hidden_layer_sizes": (),
    "critic_hidden_layer_sizes": (),
    "tau": 0.25,
    "policy_learning_rate": 0.01,
    "critic_learning_rate": 0.1,
}


def critic(*rows):
    """Linear critics: `(weight of the observation, weight of the action, bias)` each, padded to eight inputs."""
    kernel = jnp.zeros((len(rows), 8, 1)).at[:, :2, 0].set(jnp.float32([row[:2] for row in rows]))
    return {"params": {"hidden_0": {"kernel": kernel, "bias": jnp.float32([row[2:] for row in rows])}}}


def batch():
    """Two transitions from observation 0 to 1, under action 0.25; the second one terminates."""
    obs = jnp.float32([[0.0], [0.0]])
    return Batch(
        transitions=Transition(obs, obs + 0.25, jnp.float32([3.0, 3.0]), jnp.float32([0.45, 0.0]), obs + 1.0),
        reward_scale=jnp.float32(2.0),
        rate_factor=1.0,
        remaining=1.0,
    )


@pytest.fixture
def loud_noise(monkeypatch):
    """Every draw of Gaussian noise is 4."""
    monkeypatch.setattr(jax.random, "normal", lambda key, shape: jnp.full(shape, 4.0))


def make(algorithm_class, config):
    algorithm = algorithm_class(ToyTask(), 2, EvaluationConfig(1), config)
    state = algorithm.init_learner(jax.random.PRNGKey(0))
    state = state.replace(policy=jax.tree.map(jnp.zeros_like, state.policy))
    return algorithm, state.replace(target_policy=state.policy)


def test_td3_critic_update(loud_noise):
    """Target action: tanh(0) + clip(0.2 · 4, ±0.5) = 0.5. Targets' values there: 1 + 2 · 0.5 = 2 and 1 − 2 · 0.5 + 1
    = 1, of which 1 counts. So y = 2 · 3 + 0.45 · 1 = 6.45 and, terminated, 6."""
    algorithm, state = make(TD3, TD3Config(**LINEAR))
    state = state.replace(
        critic=critic((0.0, 2.0, 0.0), (0.0, 0.0, 1.0)), target_critic=critic((1.0, 2.0, 0.0), (1.0, -2.0, 1.0))
    )
    new, metrics = algorithm.critic_update(state, batch(), jax.random.PRNGKey(0))
    first, second = 0.5, 1.0  # what the two critics say now
    expected = np.mean([(first - 6.45) ** 2, (first - 6.0) ** 2]) + np.mean([(second - 6.45) ** 2, (second - 6.0) ** 2])
    assert metrics["critic_loss"] == pytest.approx(expected, rel=1e-6)
    assert metrics["critic_value"] == pytest.approx(0.75)
    # Adam's first step has the size of the learning rate, towards the target; the observation is 0 and gives none.
    expected = critic((0.0, 2.1, 0.1), (0.0, 0.1, 1.1))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), new.critic, expected)
    for untouched in ("policy", "target_policy", "target_critic"):
        jax.tree.map(np.testing.assert_array_equal, getattr(new, untouched), getattr(state, untouched))


def test_td3_full_update_moves_policy_and_targets(loud_noise):
    algorithm, state = make(TD3, TD3Config(**LINEAR))
    state = state.replace(
        critic=critic((0.0, 2.0, 0.0), (0.0, -9.0, 1.0)), target_critic=critic((1.0, 2.0, 0.0), (1.0, -2.0, 1.0))
    )
    new, _ = algorithm.full_update(state, batch(), jax.random.PRNGKey(0))
    # The policy climbs the first critic, whose value rises with the action.
    layer = new.policy["params"]["hidden_0"]
    assert float(layer["bias"][0]) == pytest.approx(0.01, rel=1e-4) and float(layer["kernel"][0, 0]) == 0.0
    for target, old, moved in (
        (new.target_policy, state.target_policy, new.policy),
        (new.target_critic, state.target_critic, new.critic),
    ):
        expected = jax.tree.map(lambda t, p: 0.75 * t + 0.25 * p, old, moved)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), target, expected)


def test_td3_gradients_are_clipped(loud_noise):
    """Adam's first moments are a tenth of them."""
    algorithm, state = make(TD3, TD3Config(**LINEAR, max_grad_norm=1e-3))
    new, _ = algorithm.full_update(state, batch(), jax.random.PRNGKey(0))
    for optimizer in (new.critic_optimizer, new.policy_optimizer):
        assert 0 < float(optax.global_norm(optax.tree.get(optimizer, "mu"))) < 1.01e-4


def test_ddpg_has_one_critic_and_no_smoothing(loud_noise):
    """Target action 0, so y = 6 + 0.45 · (1 + 0) and 6."""
    assert DDPGConfig().policy_delay == 1
    algorithm, state = make(DDPG, DDPGConfig(**LINEAR))
    assert state.critic["params"]["hidden_0"]["bias"].shape == (1, 1)
    state = state.replace(critic=critic((0.0, 2.0, 0.0)), target_critic=critic((1.0, 2.0, 0.0)))
    _, metrics = algorithm.critic_update(state, batch(), jax.random.PRNGKey(0))
    assert metrics["critic_loss"] == pytest.approx(np.mean([(0.5 - 6.45) ** 2, (0.5 - 6.0) ** 2]), rel=1e-6)


def test_each_copy_explores_with_its_own_noise():
    config = TD3Config(**LINEAR, min_exploration_noise=0.0, max_exploration_noise=0.2)
    algorithm, state = make(TD3, config)
    obs = jnp.zeros((2, 1))
    draws = jax.vmap(lambda key: algorithm.explore(state.policy, obs, key))(
        jax.random.split(jax.random.PRNGKey(1), 2000)
    )
    np.testing.assert_allclose(draws.std(axis=0)[:, 0], [0.0, 0.2], rtol=0.1)
    assert (algorithm.act(state.policy, obs, jax.random.PRNGKey(0), True) == 0).all()
