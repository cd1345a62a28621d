"""On the `c` engine, the environments equal Gymnasium's up to float32 rounding."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.mujoco.humanoid_v5 import mass_center
from helpers import OPTIMIZED

from mjx_walk.envs import TASKS, make_env
from mjx_walk.envs.physics import PhysicsState

VERSIONS = [(name, version) for name in TASKS for version in ("v5", "v4")]


def real_env(task, **kwargs):
    return gymnasium.make(task.gymnasium_id, **kwargs).unwrapped


def assert_equal_step(task, state, real, action):
    """Step both environments from the same float32 state and compare everything that Gymnasium returns."""
    obs, reward, terminated, _, info = real.step(action)
    state = task.jitted(state, action)
    np.testing.assert_array_equal(state.obs, np.float32(obs))
    # A velocity is a difference of rounded positions, divided by dt.
    position_rounding = 2 * np.spacing(np.float32(np.abs(real.data.qpos[:2]).max() + 1)) / task.dt
    np.testing.assert_allclose(state.reward, reward, rtol=3e-6, atol=1.25 * position_rounding)
    assert bool(state.terminated) == bool(terminated)
    logged = [name for name in task.reward_terms if name in info]
    assert logged or task.gymnasium_id.endswith("v4")  # some infos of v4 have no terms
    for name in logged:
        np.testing.assert_allclose(state.metrics[name], info[name], rtol=3e-6, atol=1.25 * position_rounding)
    return state


def synchronized(task, state, real):
    """The task's state set to the real environment's, after rounding both to float32."""
    arrays = (real.data.qpos, real.data.qvel, real.data.qacc_warmstart)
    rounded = [np.float32(x) for x in arrays]
    for target, value in zip(arrays, rounded, strict=True):
        target[:] = value
    memory = state.memory
    if "mass_center" in memory:
        memory = {"mass_center": jnp.float32(mass_center(real.model, real.data))}
    return state.replace(physics=PhysicsState(*map(jnp.asarray, rounded)), memory=memory)


@pytest.mark.parametrize(("name", "version"), VERSIONS)
def test_every_step_of_an_episode(name, version):
    task = make_env(name, physics="c", version=version)
    # At optimization level 0, Humanoid's center of mass is a quarter less exact than the tolerance.
    task.jitted = jax.jit(task.step, compiler_options=OPTIMIZED)
    real = real_env(task)
    real.reset(seed=0)
    state = task.reset_to(np.float32(real.data.qpos), np.float32(real.data.qvel))
    rng = np.random.default_rng(0)
    for _ in range(1000):
        action = np.float32(
            rng.uniform(-1.5, 1.5, task.action_size) * task.action_high
        )  # partly outside the motors' range
        state = assert_equal_step(task, synchronized(task, state, real), real, action)


@pytest.mark.parametrize(("name", "version"), VERSIONS)
def test_reset_observation(name, version):
    task = make_env(name, physics="c", version=version)
    real = real_env(task)
    real.reset(seed=3)
    qpos, qvel = np.float32(real.data.qpos), np.float32(real.data.qvel)
    real.set_state(np.float64(qpos), np.float64(qvel))
    np.testing.assert_array_equal(task.reset_to(qpos, qvel).obs, np.float32(real._get_obs()))
    assert task.observation_size == real.observation_space.shape[0]
    np.testing.assert_array_equal(task.action_high, real.action_space.high)
    if version == "v5":
        blocks = {k: v for k, v in real.observation_structure.items() if v and k != "skipped_qpos"}
        assert task.observation_blocks() == blocks


@pytest.mark.parametrize("name", TASKS)
def test_reset_noise_has_gymnasiums_distribution(name):
    task = make_env(name, physics="c")
    keys = jax.random.split(jax.random.PRNGKey(0), 400)
    ours = jax.vmap(task.reset)(keys).physics
    real = real_env(task)
    scale = task.options.reset_noise_scale
    noise = np.concatenate([ours.qpos - real.init_qpos.astype(np.float32), ours.qvel], axis=1)
    assert np.abs(noise).max() <= scale * (1 + 1e-5) + 1e-6
    np.testing.assert_allclose(noise.std(0), scale / np.sqrt(3), rtol=0.15)
    assert len(np.unique(np.asarray(ours.qpos), axis=0)) == 400


OPTIONS = {
    "humanoid": {
        "forward_reward_weight": 2.0,
        "ctrl_cost_weight": 0.3,
        "contact_cost_weight": 1e-5,
        "contact_cost_range": (0.0, 3.0),
        "healthy_reward": 1.5,
        "terminate_when_unhealthy": False,
        "healthy_z_range": (1.2, 1.6),
        "reset_noise_scale": 0.05,
        "frame_skip": 3,
        "exclude_current_positions_from_observation": False,
        "include_cinert_in_observation": False,
        "include_qfrc_actuator_in_observation": False,
    },
    "humanoid_standup": {
        "uph_cost_weight": 7.0,
        "ctrl_cost_weight": 0.2,
        "impact_cost_weight": 1e-5,
        "impact_cost_range": (0.0, 2.0),
        "include_cvel_in_observation": False,
        "include_cfrc_ext_in_observation": False,
        "exclude_current_positions_from_observation": False,
    },
    "walker2d": {
        "forward_reward_weight": 2.0,
        "ctrl_cost_weight": 0.1,
        "healthy_reward": 0.5,
        "terminate_when_unhealthy": False,
        "healthy_z_range": (1.0, 1.3),
        "healthy_angle_range": (-0.2, 0.2),
        "exclude_current_positions_from_observation": False,
        "frame_skip": 2,
        "xml_file": "walker2d.xml",
    },
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", TASKS)
def test_options_have_the_same_effect_as_in_gymnasium(name):
    task = make_env(name, physics="c", **OPTIONS[name])
    # Gymnasium compares dt, which depends on frame_skip, with render_fps only after it has built the class.
    real = real_env(task, **OPTIONS[name])
    assert task.gymnasium_kwargs().keys() == OPTIONS[name].keys()
    real.reset(seed=1)
    state = task.reset_to(np.float32(real.data.qpos), np.float32(real.data.qvel))
    rng = np.random.default_rng(1)
    task.jitted = jax.jit(task.step)
    for _ in range(60):
        action = np.float32(rng.uniform(-1, 1, task.action_size) * task.action_high)
        state = assert_equal_step(task, synchronized(task, state, real), real, action)


def test_time_limit_truncates_without_terminating():
    task = make_env("humanoid_standup", physics="c", max_episode_steps=3)
    state = task.reset(jax.random.PRNGKey(0))
    seen = []
    for _ in range(3):
        state = task.step(state, jnp.zeros(task.action_size))
        seen.append((bool(state.terminated), bool(state.truncated)))
    assert seen == [(False, False), (False, False), (False, True)]


@pytest.mark.parametrize(("name", "z"), [("walker2d", 1), ("humanoid", 2)])
def test_too_high_is_unhealthy(name, z):
    task = make_env(name, physics="c")
    real = real_env(task)
    real.reset(seed=0)
    qpos = np.float32(real.init_qpos)
    qpos[z] = 2.5
    real.set_state(np.float64(qpos), np.zeros(real.model.nv))
    after = task.step(task.reset_to(qpos, np.zeros(real.model.nv, np.float32)), jnp.zeros(task.action_size))
    assert real.step(np.zeros(task.action_size))[2] and bool(after.terminated)
    assert float(after.metrics["reward_survive"]) == 0.0
