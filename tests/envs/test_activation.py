"""Activations of actuators, from resets to the adapters. A hopper with filtered motors equals Gymnasium's."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_walk.envs import make_env
from mjx_walk.envs.model_files import ASSETS
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.vector_env import VectorEnv
from mjx_walk.utils.errors import UserError


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    """Gymnasium's hopper whose motors follow their controls within 40 ms."""
    path = tmp_path_factory.mktemp("model") / "filtered.xml"
    text = (ASSETS / "hopper.xml").read_text()
    motor = '<motor ctrllimited="true" ctrlrange="-1.0 1.0" gear'
    assert text.count(motor) == 3
    path.write_text(text.replace(motor, motor.replace("motor", 'general dyntype="filterexact" dynprm="0.04"')))
    return str(path)


@pytest.fixture(scope="module")
def task(model_file):
    return make_env("hopper", physics="c", xml_file=model_file)


def test_steps_equal_gymnasiums(task, model_file):
    real = gymnasium.make("Hopper-v5", xml_file=model_file).unwrapped
    real.reset(seed=0)
    state = task.reset_to(np.float32(real.data.qpos), np.float32(real.data.qvel))
    np.testing.assert_array_equal(state.physics.act, np.zeros(3))
    step, rng = jax.jit(task.step), np.random.default_rng(0)
    for i in range(15):
        for name, array in state.physics._replace(model_index=None)._asdict().items():
            if array is None:
                continue
            getattr(real.data, name)[:] = array
        if i == 10:  # Gymnasium keeps activations here
            real.set_state(np.float64(state.physics.qpos), np.float64(state.physics.qvel))
        action = np.float32(rng.uniform(-1.5, 1.5, 3))
        obs, reward, *_ = real.step(action)
        state = step(state, action)
        np.testing.assert_allclose(state.obs, obs, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(state.reward, reward, rtol=1e-4)
        np.testing.assert_allclose(state.physics.act, real.data.act, rtol=1e-6, atol=1e-7)
    assert np.abs(state.physics.act).min() > 0.01


def test_a_state_without_activations_keeps_its_leaves():
    """Programs and checkpoints of such models stay the same."""
    physics = make_env("hopper", physics="c").reset(jax.random.PRNGKey(0)).physics
    assert physics.act is None and len(jax.tree.leaves(physics)) == 3
    assert len(PhysicsState(*physics[:3])) == 5


def test_given_activations_are_checked_and_kept(task):
    state = task.reset_to(task.init_qpos, task.init_qvel, None, jnp.float32([0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(state.physics.act, np.float32([0.1, 0.2, 0.3]))
    with pytest.raises(UserError, match=r"act has the shape \(2,\); give \(3,\)"):
        task.reset_to(task.init_qpos, task.init_qvel, act=jnp.zeros(2))


@pytest.mark.parametrize("broken", [jnp.nan, jnp.inf])
def test_activations_that_are_not_finite_end_the_episode(task, broken):
    state = task.reset(jax.random.PRNGKey(0))
    step = task.engine.step
    task.engine.step = lambda *args: _with_activation(step(*args), broken)
    try:
        after = task.step(state, jnp.ones(3))
    finally:
        task.engine.step = step
    assert bool(after.terminated) and after.metrics["nonfinite"] == 1
    np.testing.assert_array_equal(after.physics.act, state.physics.act)


def _with_activation(stepped, value):
    physics, *rest = stepped
    return physics._replace(act=physics.act.at[1].set(value)), *rest


def test_finished_environments_restart_without_activation(task):
    vector_env = VectorEnv(task, 3)
    state = vector_env.init(jax.random.PRNGKey(0))
    fallen = state.env.physics.qpos.at[0, 1].set(0.3)
    state = state.replace(env=state.env.replace(physics=state.env.physics._replace(qpos=fallen)))
    others = jax.tree.map(lambda x: x[:0], state.env)
    step = jax.jit(vector_env.step)
    after, _, outcome, _ = step(state, jnp.ones((3, 3)), others, jnp.zeros((0, 3)))
    assert outcome.terminated.tolist() == [True, False, False]
    assert np.asarray(after.env.physics.act != 0).all(axis=1).tolist() == [False, True, True]
    np.testing.assert_array_equal(after.env.physics.act[0], np.zeros(3))


@pytest.mark.parametrize("num_envs", [None, 2])
def test_set_state_keeps_activations_as_in_gymnasium(model_file, num_envs):
    keywords = {"physics": "c", "xml_file": model_file}
    if num_envs:
        env = gymnasium.make_vec("mjx_walk/Hopper-v5", num_envs, **keywords)
        one = env.envs[1]
    else:
        env = gymnasium.make("mjx_walk/Hopper-v5", **keywords).unwrapped
        one = env
    env.reset(seed=0)
    env.step(np.ones(env.action_space.shape, np.float32))
    before = one._read_state().physics
    one.set_state(np.array(before.qpos), np.zeros(6))
    after = one._read_state().physics
    np.testing.assert_array_equal(after.act, before.act)
    assert (np.asarray(after.act) > 0.1).all() and not np.asarray(after.qvel).any()
    env.reset(seed=1)
    assert not np.asarray(one._read_state().physics.act).any()
    env.close()
