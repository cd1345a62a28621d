"""`data`, compared with Gymnasium's: MuJoCo's arrays at the last step."""

import copy
import functools
import pickle

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from helpers import slow_except
from side_by_side import IDS, make_both

from mjx_walk.interop import gymnasium_programs
from mjx_walk.utils.errors import UserError

IN_THE_ARENA = ("efc_", "iefc_", "efm_", "iacc", "ifrc_")
"""Prefixes of arrays in memory that MuJoCo reuses. It does not write all of them in each step."""
DIAGNOSTIC = ("solver_nnz", "solver_niter", "solver_fwdinv", "maxuse_", "parena", "pbase", "signature", "nefm")


def assert_same_data(ours, real, atol):
    """Equal numbers and arrays of all names, up to rounding relative to the largest element."""
    names = [name for name in dir(real) if not name.startswith(("_", *IN_THE_ARENA, *DIAGNOSTIC))]
    arrays = {name: getattr(real, name) for name in names}
    arrays = {name: np.asarray(x) for name, x in arrays.items() if isinstance(x, np.ndarray | float | int)}
    assert {"time", "qpos", "ctrl", "xpos", "site_xpos", "cfrc_ext", "sensordata", "qacc", "ncon"} <= arrays.keys()
    for name, expected in arrays.items():
        scale = max(1.0, np.abs(expected).max(initial=0.0))
        np.testing.assert_allclose(getattr(ours, name), expected, rtol=0, atol=atol * scale, err_msg=name)
    np.testing.assert_allclose(
        ours.efc_force, real.efc_force, atol=atol * max(1.0, np.abs(real.efc_force).max(initial=0))
    )


@pytest.mark.parametrize("name", slow_except(["Ant-v4", "Humanoid-v5", "Reacher-v5", "Walker2d-v5"], IDS))
def test_data_are_gymnasiums(name):
    """When the environment is new, after a reset, steps and `set_state`, and in copies."""
    ours, real = (env.unwrapped for env in make_both(name))
    assert_same_data(ours.data, real.data, atol=0)
    ours.reset(seed=3), real.reset(seed=3)
    assert_same_data(ours.data, real.data, atol=0)
    rng = np.random.default_rng(0)
    actions = np.float32(rng.uniform(-1, 1, (6, real.model.nu)) * real.action_space.high)
    for i, action in enumerate(actions):
        ours.step(action), real.step(action)
        assert_same_data(ours.data, real.data, atol=5e-5 if i == 0 else 2e-3)
    for state in ((real.data.qpos + 0.01, real.data.qvel), (real.init_qpos, real.init_qvel)):
        ours.set_state(*state), real.set_state(*state)
        assert_same_data(ours.data, real.data, atol=2e-3)
        np.testing.assert_array_equal(ours.data.qpos, state[0])
        ours.step(actions[0]), real.step(actions[0])
        assert_same_data(ours.data, real.data, atol=2e-3)
    for other in (copy.deepcopy(ours), pickle.loads(pickle.dumps(ours))):
        assert_same_data(other.data, ours.data, atol=0)


def test_data_of_an_mjx_engine():
    """The position is the engine's own. The other arrays are those of C, from the state before the step."""
    ours = gymnasium.make("mjx_walk/InvertedDoublePendulum-v5", physics="jax").unwrapped
    real = gymnasium.make("InvertedDoublePendulum-v5").unwrapped
    ours.reset(seed=0), real.reset(seed=0)
    for _ in range(5):
        action = ours.action_space.sample()
        ours.step(action), real.step(action)
        np.testing.assert_array_equal(np.concatenate([ours.data.qpos, ours.data.qvel]), ours.state_vector())
        assert_same_data(ours.data, real.data, atol=5e-3)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_data_of_many(mode):
    """Through resets of some environments and a `set_state` of one."""
    keywords = {"num_envs": 3, "max_episode_steps": 23, "reset_noise_scale": 0.0}
    own = {"autoreset_mode": mode}
    ours, real = make_both("Hopper-v5", gymnasium.make_vec, own, {"vector_kwargs": own}, **keywords)
    ours.reset(seed=0), real.reset(seed=0)
    rng, resets = np.random.default_rng(0), 0
    for step in range(26):
        action = np.float32(rng.uniform(-1, 1, (3, 3)))
        _, _, terminated, truncated, _ = ours.step(action)
        real.step(action)
        is_over = terminated | truncated
        if mode == AutoresetMode.DISABLED and is_over.any():
            ours.reset(options={"reset_mask": is_over}), real.reset(options={"reset_mask": is_over})
        if step == 10:
            for envs in (ours, real):
                env = envs.envs[1].unwrapped
                env.set_state(env.init_qpos + 0.1, env.init_qvel)
        if step in (1, 10) or is_over.any() or resets:
            resets += is_over.any()
            for data, expected in zip(ours.get_attr("data"), real.get_attr("data"), strict=True):
                assert_same_data(data, expected, atol=5e-3)
    assert resets
    assert_same_data(copy.deepcopy(ours).get_attr("data")[2], ours.get_attr("data")[2], atol=0)
    np.testing.assert_allclose(ours.call("get_body_com", "foot"), real.call("get_body_com", "foot"), atol=5e-3)


def hopper():
    env = gymnasium.make("mjx_walk/Hopper-v5", physics="c").unwrapped
    env.reset(seed=0)
    return env


def test_data_follow_the_environment():
    env = hopper()
    data, first = env.data, env.data.qpos[0]
    kept = copy.copy(data)
    assert isinstance(data, mujoco.MjData) and env.data is data and data.time == 0.0
    env.step(np.ones(3))
    assert data.qpos[0] != first and data.time == pytest.approx(env.dt) and list(data.ctrl) == [1, 1, 1]
    assert env.data is data and kept.qpos[0] == first
    for other in (copy.deepcopy(data), pickle.loads(pickle.dumps(data))):
        assert type(other) is mujoco.MjData
        other.qpos[0] = 5.0
        np.testing.assert_array_equal(other.xpos, data.xpos)
    mujoco.mj_kinematics(env.model, env.data)
    assert data.body("torso").xpos[0] == data.qpos[0]
    env.step(np.ones(3))


def test_data_cannot_be_written_to():
    env = hopper()
    data = env.data
    for array in (data.qpos, data.ctrl, data.xpos, data.efc_force, data.xfrc_applied):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
    for name in ("qpos", "time"):
        with pytest.raises(UserError, match=f"ignores your value of data.{name}; use set_state instead"):
            setattr(data, name, 1.0)
    step = functools.partial(env.step, np.zeros(3))
    for call in (step, env.reset, lambda: env.set_state(env.init_qpos, env.init_qvel)):
        data.joint("rootx").qpos[0] = 1.0
        with pytest.raises(UserError, match=r"ignores your change to data\.qpos; use set_state instead"):
            call()
        assert data.qpos[0] != 1.0
        call()
    mujoco.mj_step(env.model, env.data)
    with pytest.raises(UserError, match=r"ignores your change to data\.time"):
        step()
    envs = gymnasium.make_vec("mjx_walk/Hopper-v5", num_envs=2, physics="c")
    envs.reset()
    envs.get_attr("data")[1].actuator(0).ctrl[0] = 1.0
    with pytest.raises(UserError, match=r"ignores your change to data\.ctrl"):
        envs.step(np.zeros((2, 3)))


def test_data_agree_with_info_when_the_physics_is_randomized():
    """With another model, pushes, and noisy and late actions."""
    randomize = {"mass": (0.7, 1.3), "latency": (0.01, 0.06), "action_noise": 0.1, "push": 1.0}
    randomize["push_seconds"] = (0.05, 0.1)
    env = gymnasium.make("mjx_walk/Ant-v5", physics="c", randomize=randomize).unwrapped
    env.reset(seed=0)
    old = env.get_body_com("torso")
    for _ in range(5):
        info = env.step(np.ones(8))[4]
        new = env.get_body_com("torso")
        np.testing.assert_allclose((new - old)[0] / env.dt, info["x_velocity"], rtol=1e-5)
        old = new


@pytest.mark.parametrize("name", ["Ant-v5", "Swimmer-v4"])
def test_info_equals_what_is_computed_from_data(name):
    """Bit for bit, as in Gymnasium, though the engine computes in float32."""
    env = gymnasium.make(f"mjx_walk/{name}", physics="c").unwrapped
    env.reset(seed=0)
    position = (lambda: env.get_body_com("torso")[:2]) if name == "Ant-v5" else (lambda: env.data.qpos[:2].copy())
    for _ in range(3):
        old = position()
        info = env.step(env.action_space.sample())[4]
        assert ((position() - old) / env.dt).tolist() == [info["x_velocity"], info["y_velocity"]]
        assert info["distance_from_origin"] == np.linalg.norm(env.data.qpos[:2])


def test_data_stay_when_the_physics_is_not_finite():
    env = gymnasium.make("mjx_walk/HalfCheetah-v5", physics="c").unwrapped
    env.reset(seed=0)
    env.set_state(env.init_qpos, np.full(9, 9e9))
    before = copy.copy(env.data)
    assert env.step(np.zeros(6))[4]["nonfinite"] == 1.0
    np.testing.assert_array_equal(env.data.qvel, before.qvel)
    np.testing.assert_array_equal(env.data.xpos, before.xpos)


def test_hills_are_refused():
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(UserError, match="Gymnasium's floor is flat; leave ground out"):
            make("mjx_walk/Hopper-v5", physics="c", ground="steps")


def test_data_of_a_forked_process_are_refused(monkeypatch):
    monkeypatch.setattr(gymnasium_programs, "_process_of_jax", [1])
    env = gymnasium.make("mjx_walk/Hopper-v5", physics="c").unwrapped
    with pytest.raises(gymnasium.error.Error, match=r"vector_kwargs={'context': 'spawn'}"):
        _ = env.data
