"""The tasks through Brax's interface."""

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.wrappers import training

from mjx_walk.envs import make_env
from mjx_walk.interop.brax_env import BraxEnv


def test_brax_wrappers_drive_it():
    """Brax's own limit, resets and vmap around it; every step is the task's."""
    env = BraxEnv("humanoid", physics="c", reset_noise_scale=0.05)
    assert (env.observation_size, env.action_size, env.backend) == (348, 17, "c")
    wrapped = training.wrap(env, episode_length=25)
    task = make_env("humanoid", "c", reset_noise_scale=0.05)
    step, alone = jax.jit(wrapped.step), jax.jit(jax.vmap(task.step))
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 4))
    first, fell, cut = np.asarray(state.obs), 0, 0
    key = jax.random.PRNGKey(1)
    for _ in range(60):
        key, draw = jax.random.split(key)
        action = jax.random.uniform(draw, (4, 17), minval=-1.0)
        before = state.pipeline_state
        state = step(state, action)
        expected = alone(before, 0.4 * action)
        np.testing.assert_allclose(state.reward, expected.reward, rtol=1e-4)
        truncated = np.asarray(state.info["truncation"]) > 0
        np.testing.assert_array_equal(np.asarray(state.done) > 0, np.asarray(expected.terminated) | truncated)
        over = np.asarray(state.done) > 0
        np.testing.assert_array_equal(np.asarray(state.obs)[over], first[over])
        fell, cut = fell + (over & ~truncated).sum(), cut + truncated.sum()
    assert fell > 0 and cut > 0
    np.testing.assert_allclose(state.metrics["reward_survive"], 5.0)
    assert jnp.isfinite(state.obs).all()
