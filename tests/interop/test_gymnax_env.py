"""The tasks through gymnax's interface, and rejax's PPO on them as it is."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blocks

from mjx_walk.envs import make_env
from mjx_walk.interop.gymnax_env import EnvParams, GymnaxEnv

N = 20
LIMIT = EnvParams(max_steps_in_episode=30)


def keys(seed, shape=(N,)):
    return jax.random.split(jax.random.PRNGKey(seed), shape)


@functools.cache
def walker():
    return GymnaxEnv("walker2d", "c", final_observation=True)


def rollout(env, actions, params):
    """States `[T, …]` that the actions `[T, N, action_size]` give, what `step` returns, and the keys of the steps."""
    step_keys = keys(1, (len(actions), N))
    _, first = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys(0), params)

    def step(state, inputs):
        out = jax.vmap(env.step, in_axes=(0, 0, 0, None))(inputs[0], state, inputs[1], params)
        return out[1], (state, out)

    _, (states, out) = jax.jit(functools.partial(jax.lax.scan, step))(first, (step_keys, actions))
    return states, out, step_keys


def test_each_step_is_the_tasks_until_the_episode_ends():
    """`vmap` in `scan`: falls of several environments in a step, and time limits of many."""
    env, task = walker(), make_env("walker2d", "c")
    actions = jax.random.uniform(jax.random.PRNGKey(2), (90, N, 6), minval=-1.0)
    states, (obs, after, reward, done, info), step_keys = rollout(env, actions, LIMIT)
    expected = jax.jit(jax.vmap(jax.vmap(task.step)))(states, actions)
    np.testing.assert_array_equal(reward, expected.reward)
    np.testing.assert_array_equal(info["final_observation"], expected.obs)
    np.testing.assert_array_equal(info["terminated"], expected.terminated)
    np.testing.assert_array_equal(info["truncated"], expected.steps == 30)
    np.testing.assert_array_equal(done, info["terminated"] | info["truncated"])
    np.testing.assert_array_equal(info["discount"], 1.0 - expected.terminated)
    assert info["terminated"].sum(1).max() > 2 and (info["truncated"] & ~info["terminated"]).any()
    starts = jax.jit(jax.vmap(jax.vmap(lambda key: task.reset(jax.random.split(key)[1]))))(step_keys)
    chosen = [
        jnp.where(done.reshape(done.shape + (1,) * (new.ndim - 2)), new, old)
        for new, old in zip(jax.tree.leaves(starts), jax.tree.leaves(expected), strict=True)
    ]
    after_steps = jnp.where(done, 0, expected.steps)
    np.testing.assert_array_equal(after.steps, after_steps)
    after = after.replace(truncated=jnp.where(done, False, expected.truncated))
    for actual, wanted in zip(jax.tree.leaves(after), chosen, strict=True):
        np.testing.assert_array_equal(actual, wanted)
    np.testing.assert_array_equal(obs, after.obs)


@pytest.mark.parametrize("num_done", [0, 1, 3, N])
def test_any_number_of_environments_may_end_at_once(num_done):
    env = walker()
    _, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys(0), None)
    is_last = np.random.default_rng(num_done).permutation(N) < num_done
    state = state.replace(steps=jnp.where(is_last, 999, 7))
    obs, after, _, done, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys(3), state, jnp.zeros((N, 6)), None)
    np.testing.assert_array_equal(done, is_last)
    np.testing.assert_array_equal(after.steps, np.where(is_last, 0, 8))
    np.testing.assert_array_equal((obs != info["final_observation"]).any(1), is_last)


@pytest.mark.parametrize("make_key", [jax.random.PRNGKey, jax.random.key])
def test_one_environment_and_nested_batches_agree(make_key):
    env = walker()
    params = EnvParams(max_steps_in_episode=1)
    nested = jax.random.split(make_key(4), (2, 3))
    _, state = jax.vmap(jax.vmap(env.reset))(nested)
    action = jnp.full((2, 3, 6), 0.1)
    step = functools.partial(env.step, params=params)
    obs, *_ = jax.vmap(jax.vmap(step))(nested, state, action)
    one = env.step(nested[1, 2], jax.tree.map(lambda x: x[1, 2], state), action[1, 2], params)
    fresh, _ = env.reset(jax.random.split(nested[1, 2])[1])
    assert one[3]
    np.testing.assert_array_equal(obs[1, 2], one[0])
    np.testing.assert_array_equal(one[0], fresh)


@pytest.mark.parametrize("physics", [pytest.param("jax", marks=pytest.mark.long), "warp"])
@pytest.mark.slow
def test_other_engines(physics):
    env = GymnaxEnv("inverted_pendulum", physics, max_episode_steps=5)
    assert env.default_params.max_steps_in_episode == 5
    actions = jnp.full((7, N, 1), 0.2)
    _, (obs, after, _, done, info), _ = rollout(env, actions, None)
    np.testing.assert_array_equal(done.all(1), np.arange(7) == 4)
    assert "final_observation" not in info
    assert after.steps[4].max() == 0 and len(np.unique(obs[4], axis=0)) == N and np.abs(obs[4]).max() <= 0.01


def test_what_gymnaxs_environments_have():
    env = walker()
    space, observations = env.action_space(env.default_params), env.observation_space(env.default_params)
    assert (env.name, env.num_actions, space.shape, observations.shape) == ("walker2d", 6, (6,), (17,))
    assert (space.low, space.high, observations.low, observations.high) == (-1.0, 1.0, -np.inf, np.inf)
    samples = jax.vmap(space.sample)(keys(0))
    assert samples.dtype == space.dtype and np.abs(samples).max() > 0.9
    assert space.contains(samples[0]) and not space.contains(samples[0] + 2.0)
    assert env.default_params == EnvParams(max_steps_in_episode=1000)
    assert GymnaxEnv("inverted_pendulum", "c").action_space().high == 3.0
    with jax.enable_x64(True):
        obs, state = env.reset(jax.random.PRNGKey(0))
        out = env.step(jax.random.PRNGKey(1), state, np.zeros(6))
        assert obs.dtype == out[0].dtype == out[2].dtype == jnp.float32 and out[3].dtype == bool


def test_motors_of_different_ranges(tmp_path):
    pole = '<body name="torso"><joint name="slider" type="slide"/><geom size="0.1"/></body>'
    motors = '<motor joint="slider" ctrlrange="-1 2"/><motor joint="slider" ctrlrange="-3 4"/>'
    model = tmp_path / "two.xml"
    model.write_text(
        f'<mujoco><worldbody>{pole}<body><joint type="hinge"/><geom size="0.1"/></body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    space = GymnaxEnv("inverted_pendulum", "c", xml_file=str(model)).action_space()
    np.testing.assert_array_equal([space.low, space.high], [[-1, -3], [2, 4]])
    assert space.contains(space.sample(jax.random.PRNGKey(0)))


def test_actions_of_other_shapes():
    """rejax squeezes actions, so a single motor takes a number."""
    env = GymnaxEnv("inverted_pendulum", "c")
    _, state = env.reset(jax.random.PRNGKey(0))
    obs = [env.step(jax.random.PRNGKey(0), state, action)[0] for action in (jnp.float32(1.0), jnp.ones(1))]
    np.testing.assert_array_equal(*obs)
    for action in (jnp.zeros(2), jnp.zeros((1, 1))):
        with pytest.raises(ValueError, match="Action dimension mismatch"):
            env.step(jax.random.PRNGKey(0), state, action)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_rejaxs_ppo_learns_to_balance():
    pytest.importorskip("rejax", reason="docs/adapters.md says how to install it")
    (example,) = [block for block in blocks("python") if block.startswith("# in_rejax.py")]
    exec(example, names := {})
    first, _, last = np.asarray(names["returns"]).mean(axis=1)
    assert last > 10 * first
