"""On the `c` engine, the environments equal Gymnasium's up to float32 rounding."""

import inspect

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.stats
from gymnasium.envs.mujoco.humanoid_v5 import mass_center
from helpers import OPTIMIZED

from mjx_walk.envs import GYMNASIUM_TASKS, TASKS, make_env
from mjx_walk.envs.models import model_path
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.machine.quiet_mujoco import hide_deprecations

VERSIONS = [(name, version) for name in GYMNASIUM_TASKS for version in TASKS[name][0].XML_FILES]
COMPUTED = ("sin", "cos", "to_target")
"""Blocks of observations that are computed from MuJoCo's arrays, so float32 rounds them more than once."""


def real_env(task, **kwargs):
    with hide_deprecations():
        return gymnasium.make(task.gymnasium_id, **kwargs).unwrapped


def assert_equal_observation(task, obs, real, expected):
    """Equal after rounding to float32; computed blocks differ by the rounding of what they are computed from."""
    start, rounding = 0, np.spacing(np.float32(np.abs(real.data.qpos).max() + 1))
    for name, size in task.observation_blocks().items():
        block = np.s_[start : start + size]
        if name in COMPUTED:
            np.testing.assert_allclose(obs[block], expected[block], rtol=0, atol=rounding)
        else:
            np.testing.assert_array_equal(obs[block], np.float32(expected[block]), err_msg=name)
        start += size
    assert obs.shape == expected.shape == (start,)


def assert_equal_step(task, state, real, action):
    """Step both environments from the same float32 state and compare everything that Gymnasium returns."""
    obs, reward, terminated, _, info = real.step(action)
    state = jax.device_get(task.jitted(state, action))
    assert_equal_observation(task, state.obs, real, obs)
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
    physics = PhysicsState(*rounded)
    memory = task.jitted_carry(physics, {name: np.float32(getattr(real.data, name)) for name in task.derived_names()})
    if "mass_center" in memory:  # its sum in float32 is a quarter less exact than the tolerance
        memory = {"mass_center": jnp.float32(mass_center(real.model, real.data))}
    return state.replace(physics=physics, memory=memory)


SLOW_IF_OLD = [
    (name, version) if version == "v5" or name == "humanoid" else pytest.param(name, version, marks=pytest.mark.slow)
    for name, version in VERSIONS
]


@pytest.mark.parametrize(("name", "version"), SLOW_IF_OLD)
def test_every_step_of_an_episode(name, version):
    task = make_env(name, physics="c", version=version)
    # At optimization level 0, Humanoid's center of mass is a quarter less exact than the tolerance.
    task.jitted, task.jitted_carry = jax.jit(task.step, compiler_options=OPTIMIZED), jax.jit(task.carry)
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
    assert_equal_observation(task, task.reset_to(qpos, qvel).obs, real, real._get_obs())
    assert task.observation_size == real.observation_space.shape[0]
    np.testing.assert_array_equal(task.action_high, real.action_space.high)
    assert task.options.max_episode_steps == gymnasium.spec(task.gymnasium_id).max_episode_steps
    if version == "v5" and hasattr(real, "observation_structure"):
        blocks = {k: v for k, v in real.observation_structure.items() if v and k != "skipped_qpos"}
        assert task.observation_blocks() == blocks


@pytest.mark.parametrize("name", GYMNASIUM_TASKS)
def test_resets_have_gymnasiums_distribution(name):
    """Each coordinate by itself, and the distances that Gymnasium's targets and objects must keep."""
    task = make_env(name, physics="c")
    ours = jax.vmap(task.initial_state)(jax.random.split(jax.random.PRNGKey(0), 1000))
    real = real_env(task)
    theirs = []
    for seed in range(1000):
        real.reset(seed=seed)
        theirs.append((real.data.qpos.copy(), real.data.qvel.copy()))
    for our, their in zip(ours, map(np.array, zip(*theirs, strict=True)), strict=True):
        distances = (np.linalg.norm(x[:, -2:], axis=1, keepdims=True) for x in (our, their))
        objects = (np.linalg.norm(x[:, -4:-2], axis=1, keepdims=True) for x in (our, their))
        our, their = (np.hstack(parts) for parts in zip((our, their), distances, objects, strict=True))
        for column in range(our.shape[1]):
            assert scipy.stats.ks_2samp(our[:, column], np.float32(their[:, column])).pvalue > 1e-5, column
    assert len(np.unique(np.asarray(ours[0]), axis=0)) == 1000


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
        "include_cvel_in_observation": False,
        "include_qfrc_actuator_in_observation": False,
        "include_cfrc_ext_in_observation": False,
    },
    "humanoid_standup": {
        "uph_cost_weight": 7.0,
        "ctrl_cost_weight": 0.2,
        "impact_cost_weight": 1e-5,
        "impact_cost_range": (0.0, 2.0),
        "reset_noise_scale": 0.05,
        "frame_skip": 3,
        "exclude_current_positions_from_observation": False,
        "include_cinert_in_observation": False,
        "include_cvel_in_observation": False,
        "include_qfrc_actuator_in_observation": False,
        "include_cfrc_ext_in_observation": False,
    },
    "walker2d": {
        "forward_reward_weight": 2.0,
        "ctrl_cost_weight": 0.1,
        "healthy_reward": 0.5,
        "terminate_when_unhealthy": False,
        "healthy_z_range": (1.0, 1.3),
        "healthy_angle_range": (-0.2, 0.2),
        "reset_noise_scale": 0.05,
        "exclude_current_positions_from_observation": False,
        "frame_skip": 2,
    },
    "ant": {
        "forward_reward_weight": 2.0,
        "ctrl_cost_weight": 0.1,
        "use_contact_forces": True,
        "contact_cost_weight": 0.02,
        "contact_force_range": (-0.5, 3.0),
        "healthy_reward": 0.5,
        "main_body": "front_left_leg",
        "terminate_when_unhealthy": False,
        "healthy_z_range": (0.5, 0.8),
        "reset_noise_scale": 0.2,
        "exclude_current_positions_from_observation": False,
        "include_cfrc_ext_in_observation": False,
        "frame_skip": 3,
    },
    "half_cheetah": {
        "forward_reward_weight": 2.0,
        "ctrl_cost_weight": 0.5,
        "reset_noise_scale": 0.2,
        "exclude_current_positions_from_observation": False,
        "frame_skip": 3,
    },
    "hopper": {
        "forward_reward_weight": 2.0,
        "ctrl_cost_weight": 0.1,
        "healthy_reward": 0.5,
        "terminate_when_unhealthy": False,
        "healthy_state_range": (-2.0, 2.0),
        "healthy_z_range": (0.9, 1.3),
        "healthy_angle_range": (-0.1, 0.3),
        "reset_noise_scale": 0.05,
        "exclude_current_positions_from_observation": False,
        "frame_skip": 2,
    },
    "swimmer": {
        "forward_reward_weight": 2.0,
        "ctrl_cost_weight": 0.1,
        "reset_noise_scale": 0.2,
        "exclude_current_positions_from_observation": False,
        "frame_skip": 2,
    },
    "reacher": {"reward_dist_weight": 2.0, "reward_control_weight": 0.3, "frame_skip": 3},
    "pusher": {
        "reward_near_weight": 0.7,
        "reward_dist_weight": 2.0,
        "reward_control_weight": 0.3,
        "frame_skip": 3,
    },
    "inverted_pendulum": {"reset_noise_scale": 0.1, "frame_skip": 1},
    "inverted_double_pendulum": {"healthy_reward": 3.0, "reset_noise_scale": 0.05, "frame_skip": 2},
}
"""For each task every keyword, with a value other than its default, except `xml_file`."""


def options_of(name, version, tmp_path):
    """The keywords that a version takes, and a model with halved motors."""
    task = TASKS[name][0]
    refused = {"v5": task.V4_ONLY, "v4": task.V5_ONLY}[version]
    options = {option: value for option, value in OPTIONS[name].items() if option not in refused}
    if "xml_file" in refused:
        return options
    spec = mujoco.MjSpec.from_file(str(model_path(task.XML_FILES[version])))
    for actuator in spec.actuators:
        actuator.gear = [0.5 * ratio for ratio in actuator.gear]
    (tmp_path / "model.xml").write_text(spec.to_xml())
    return options | {"xml_file": str(tmp_path / "model.xml")}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("name", "version"), VERSIONS)
def test_options_have_the_same_effect_as_in_gymnasium(name, version, tmp_path):
    options = options_of(name, version, tmp_path)
    task = make_env(name, physics="c", version=version, **options)
    # Gymnasium compares dt, which depends on frame_skip, with render_fps only after it has built the class.
    real = real_env(task, **options)
    assert task.gymnasium_kwargs().keys() == options.keys()
    real.reset(seed=1)
    state = task.reset_to(np.float32(real.data.qpos), np.float32(real.data.qvel))
    rng = np.random.default_rng(1)
    task.jitted, task.jitted_carry = jax.jit(task.step), jax.jit(task.carry)
    for _ in range(60):
        action = np.float32(rng.uniform(-1, 1, task.action_size) * task.action_high)
        state = assert_equal_step(task, synchronized(task, state, real), real, action)


@pytest.mark.parametrize(("name", "version"), VERSIONS)
def test_every_keyword_is_tried(name, version):
    """Gymnasium's constructors, apart from what renders, have no keyword that the test above leaves out."""
    real = gymnasium.envs.registration.load_env_creator(
        gymnasium.spec(f"{TASKS[name][0].GYMNASIUM_NAME}-{version}").entry_point
    )
    theirs = inspect.signature(real.__init__).parameters.keys() - {"self", "kwargs", "default_camera_config"}
    refused = {"v5": TASKS[name][0].V4_ONLY, "v4": TASKS[name][0].V5_ONLY}[version]
    assert theirs == (OPTIONS[name].keys() | {"xml_file"}) - {*refused}


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
