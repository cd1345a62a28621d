"""The tasks through Brax's interface."""

import operator
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers import training

from mjx_walk.envs import make_env
from mjx_walk.interop.brax_env import BraxEnv
from mjx_walk.utils.errors import UserError


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


def test_what_braxs_environments_have():
    env = BraxEnv("humanoid", physics="c")
    assert env.dt == make_env("humanoid", "c").dt and env.sys.nq == 24
    np.testing.assert_array_equal(env.sys.actuator.ctrl_range, [[-1.0, 1.0]] * 17)
    with jax.enable_x64(True):
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        assert state.done.dtype == jax.jit(env.step)(state, np.zeros(17)).done.dtype == jnp.float32
    for action in (0.3, np.zeros(16), np.zeros((1, 17))):
        with pytest.raises(ValueError, match="Action dimension mismatch"):
            env.step(state, action)


@pytest.mark.filterwarnings("ignore")
def test_braxs_wrapper_for_gym_drives_it():
    pytest.importorskip("gym", reason="pip install gym")
    gym_wrapper = pytest.importorskip("brax.envs.wrappers.gym").GymWrapper
    env = gym_wrapper(BraxEnv("walker2d", physics="c"))
    assert env.reset().shape == (17,) and env.action_space.shape == (6,)
    obs, reward, _, info = env.step(np.zeros(6, np.float32))
    assert obs.shape == (17,) and np.isfinite(reward) and "reward_forward" in info


def masses_times_half_one_and_two(sys):
    in_axes = jax.tree.map(lambda _: None, sys).tree_replace({"body_mass": 0})
    return sys.tree_replace({"body_mass": jnp.outer(jnp.array([0.5, 1.0, 2.0]), sys.body_mass)}), in_axes


def test_domain_randomization_needs_an_engine_that_can_change_its_model():
    env = training.DomainRandomizationVmapWrapper(BraxEnv("walker2d", physics="c"), masses_times_half_one_and_two)
    with pytest.raises(UserError, match=r"use BraxEnv.*physics='jax'"):
        env.reset(jax.random.split(jax.random.PRNGKey(0), 3))


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("link.inertia.mass", "'link.inertia.mass' of a Brax system; change body_mass instead"),
        ("actuator.gear", "'actuator.gear' of a Brax system; change actuator_gear instead"),
        ("dof.limit", "'dof.limit.0' of a Brax system; change jnt_range instead"),
        ("elasticity", "'elasticity' of a Brax system; change an array of mjx.Model, such as body_mass or opt.gravity"),
    ],
)
def test_randomization_that_the_physics_does_not_read(name, advice):
    env = BraxEnv("inverted_pendulum", physics="jax")
    changed = jax.tree.map(lambda x: 2 * x, operator.attrgetter(name)(env.sys))
    with pytest.raises(UserError, match=re.escape(f"the physics does not read {advice}")):
        env.sys = env.sys.tree_replace({name: changed})
    with pytest.raises(UserError, match=r"'body_mass' of this model has shape \(3,\), not \(1,\)"):
        env.sys = env.sys.replace(body_mass=jnp.ones(1))


def doubled(env, name):
    return env.sys.tree_replace({name: 2 * operator.attrgetter(name)(env.sys) + 1})


@pytest.mark.parametrize("name", ["opt.density", "opt.wind", "dof_frictionloss", "body_gravcomp"])
def test_randomization_of_what_the_model_does_not_have(name):
    env = BraxEnv("inverted_pendulum", physics="jax")
    with pytest.raises(UserError, match=f"MJX does not read '{name}'; give it a value"):
        env.sys = doubled(env, name)
    in_a_medium = BraxEnv("swimmer", physics="jax")
    for changed in ("opt.density", "opt.wind", "dof_damping"):
        in_a_medium.sys = doubled(in_a_medium, changed)


@pytest.mark.slow
def test_domain_randomization():
    """The environment with the model's own masses steps as without the wrapper, the others differ."""
    env = BraxEnv("walker2d", physics="jax")
    wrapped = training.DomainRandomizationVmapWrapper(env, masses_times_half_one_and_two)
    key, action = jax.random.PRNGKey(0), jnp.full(6, 0.5)
    many = jax.jit(wrapped.step)(jax.jit(wrapped.reset)(jnp.tile(key, (3, 1))), jnp.tile(action, (3, 1)))
    one = jax.jit(env.step)(jax.jit(env.reset)(key), action)
    np.testing.assert_allclose(many.obs[1], one.obs, atol=1e-5)
    assert min(np.abs(many.obs[i] - one.obs).max() for i in (0, 2)) > 0.01
