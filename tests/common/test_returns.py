"""Hand-computed returns."""

import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo.losses import compute_gae

from mjx_walk.common.returns import (
    bootstrap_truncated,
    init_return_scale,
    returns_to_go,
    reward_multiplier,
    update_return_scale,
)


def test_truncation_bootstraps_and_termination_does_not():
    """Brax's GAE, fed as `on_policy.collect` feeds it, against sums done by hand. γ = 0.5, λ = 1, values all 8."""
    reward = jnp.array([[1.0, 1.0, 1.0]] * 2)  # [T=2, B=3]: continues, truncated at 0, terminated at 0
    truncated = jnp.array([[False, True, False], [False, False, False]])
    ended = jnp.array([[0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    scale = 2.0
    folded = bootstrap_truncated(reward, truncated, jnp.full((2, 3), 8.0), 0.5, scale) * scale
    targets, advantages = compute_gae(
        truncation=jnp.zeros((2, 3)),
        termination=ended,
        rewards=folded,
        values=jnp.full((2, 3), 8.0),
        bootstrap_value=jnp.full(3, 8.0),
        lambda_=1.0,
        discount=0.5,
    )
    # Rewards scaled by 2: from the last step 2 + 0.5·8 = 6; one step earlier 2 + 0.5·6 = 5.
    # Truncated: 2 + 0.5·8 = 6, its own future; terminated: 2, no future.
    np.testing.assert_allclose(targets, [[5.0, 6.0, 2.0], [6.0, 6.0, 6.0]])
    np.testing.assert_allclose(advantages, [[-3.0, -2.0, -6.0], [-2.0, -2.0, -2.0]])


def test_return_scale_is_the_std_of_discounted_returns():
    rng = np.random.default_rng(0)
    reward = rng.normal(3.0, 2.0, (50, 4)).astype(np.float32)
    done = rng.random((50, 4)) < 0.1
    scale = init_return_scale(4)
    for block in range(5):  # one unroll at a time
        part = slice(10 * block, 10 * block + 10)
        scale = update_return_scale(scale, jnp.asarray(reward[part]), jnp.asarray(done[part]), 0.9)
    running, returns = np.zeros(4), []
    for r, d in zip(reward, done, strict=True):
        running = 0.9 * running + r
        returns.append(running.copy())
        running[d] = 0.0
    np.testing.assert_allclose(reward_multiplier(scale), 1 / np.std(returns), rtol=1e-4)
    bound = 0.5 * np.abs(returns).max() / np.std(returns)
    np.testing.assert_allclose(reward_multiplier(scale, bound), bound / np.abs(returns).max(), rtol=1e-4)
    np.testing.assert_allclose(reward_multiplier(scale, 4 * bound), 1 / np.std(returns), rtol=1e-4)
    np.testing.assert_allclose(scale.mean, np.mean(returns), rtol=1e-4)


def test_returns_to_go_by_hand():
    """Three environments: one terminates after the second step, one is truncated there, one continues."""
    reward = jnp.float32([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [4.0, 4.0, 4.0]])
    terminated = jnp.array([[False, False, False], [True, False, False], [False, False, False]])
    truncated = jnp.array([[False, False, False], [False, True, False], [False, False, False]])
    sums, unseen = returns_to_go(reward, terminated, truncated, 0.5)
    np.testing.assert_allclose(sums, [[2.0, 2.0, 3.0], [2.0, 2.0, 4.0], [4.0, 4.0, 4.0]])
    np.testing.assert_allclose(unseen, [[0.0, 0.25, 0.125], [0.0, 0.5, 0.25], [0.5, 0.5, 0.5]])
