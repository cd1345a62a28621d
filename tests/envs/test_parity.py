"""The MJX engines against MuJoCo's C library, one step at a time, with the tolerances of `evaluation.engine_parity`."""

import ctypes

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import OPTIMIZED, command_here, slow_except

from mjx_walk import parity as parity_command
from mjx_walk.envs import GYMNASIUM_TASKS, make_env
from mjx_walk.envs.physics import PhysicsState, make_engine, mjx_warp
from mjx_walk.evaluation import engine_parity
from mjx_walk.evaluation.random_steps import take_random_steps
from mjx_walk.machine.compat import prepare_jax
from mjx_walk.utils.errors import UserError

prepare_jax()  # before any test of this process starts JAX

_M_PERTURB = -6
"""What `mallopt` calls `MALLOC_PERTURB_`."""


@pytest.fixture(autouse=True)
def _new_memory_holds_no_zeros():
    """On a CPU, without `prepare_jax`, reductions over large batches read memory that was never written."""
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_PERTURB, 128)
    yield
    libc.mallopt(_M_PERTURB, 0)


FAST = [("humanoid", "v5", "warp"), ("half_cheetah", "v5", "jax")]
"""Both engines, both integrators."""
EVERY = [(name, "v5", physics) for name in GYMNASIUM_TASKS for physics in ("jax", "warp")]
EVERY += [("walker2d", "v4", "warp")]
"""Every model; the older Walker2d's on Warp alone. The versions of the other tasks share theirs."""
LONG = ("humanoid_standup", "v5", "jax")
"""Its body is Humanoid's."""
SLOW, SLOW_AND_LONG = [pytest.mark.slow], [pytest.mark.slow, pytest.mark.long]
CASES = [
    *FAST,
    *(pytest.param(*case, marks=SLOW_AND_LONG if case == LONG else SLOW) for case in EVERY if case not in FAST),
]


@pytest.mark.parametrize(("name", "version", "physics"), CASES)
def test_one_step_from_standing_airborne_thrown_and_fallen_states(name, version, physics):
    reference, task = (make_env(name, physics=engine, version=version) for engine in ("c", physics))
    states, actions = jax.device_get(engine_parity.reference_states(reference, num_envs=24, num_steps=70, seed=0))
    stepped = jax.jit(jax.vmap(task.step), compiler_options=OPTIMIZED)(states, actions)
    found = engine_parity.compare(task, engine_parity.one_step(reference, states, actions), jax.device_get(stepped))
    assert found.is_within, "\n".join(map(str, found.errors))
    assert found.num_steps >= 1600 and found.nonfinite == 0
    if task.terminates_on_fall:  # both sides of the healthy range were visited
        assert 100 < found.num_terminations < found.num_steps - 100


@pytest.mark.parametrize("physics", ["jax", "warp"])
def test_euler_damps_joints_implicitly(physics):
    """With explicit damping, a light joint with strong damping would blow up at this time step."""
    model = mujoco.MjModel.from_xml_string(DAMPED_HINGE)
    state = PhysicsState(jnp.float32([0.3]), jnp.float32([5.0]), jnp.zeros(1))
    found, expected = (make_engine(name, model, 5, ()).step(state, jnp.zeros(0))[0] for name in (physics, "c"))
    assert 0 < abs(float(expected.qvel[0])) < 1.0
    np.testing.assert_allclose(found.qvel, expected.qvel, rtol=1e-4)
    np.testing.assert_allclose(found.qpos, expected.qpos, rtol=1e-5)


DAMPED_HINGE = """
<mujoco>
  <option integrator="Euler" timestep="0.01"/>
  <worldbody>
    <body><joint damping="1"/><geom type="capsule" size="0.05 0.2" pos="0 0 -0.2" mass="0.1"/></body>
  </worldbody>
</mujoco>
"""

TILTED_CAPSULE = """
<mujoco>
  <option integrator="RK4" timestep="0.003"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.19"><freejoint/><geom type="capsule" size="0.1 0.1" mass="1"/></body>
  </worldbody>
  <actuator/>
</mujoco>
"""


@pytest.mark.parametrize("physics", ["jax", "warp"])
@pytest.mark.parametrize("tilt", [5.0, 25.0, 60.0])
def test_a_steep_capsule_slides_as_in_c(physics, tilt):
    """Its contact's tangent follows its axis: MJX as released takes a default one within 30° of the normal."""
    model = mujoco.MjModel.from_xml_string(TILTED_CAPSULE)
    half, azimuth = np.deg2rad(tilt) / 2, np.deg2rad(35.0)
    quaternion = [np.cos(half), np.sin(half) * np.cos(azimuth), np.sin(half) * np.sin(azimuth), 0.0]
    height = 0.1 + 0.1 * np.cos(2 * half) - 0.005
    qpos = jnp.float32([0.0, 0.0, height, *quaternion])
    state = PhysicsState(qpos, jnp.float32([0.7, 0.2, 0, 0, 0, 0]), jnp.zeros(6))
    found, expected = (make_engine(name, model, 1, ()).step(state, jnp.zeros(0))[0] for name in (physics, "c"))
    assert np.abs(np.asarray(expected.qvel) - state.qvel).max() > 1e-3
    np.testing.assert_allclose(found.qvel, expected.qvel, atol=2e-4)


def test_the_compiler_reduces_a_large_batch_right():
    """The premise of every other test here; without the flag of `prepare_jax`, jaxlib 0.10.2 fails it on a CPU."""
    rows = jnp.zeros((40_000, 3)).at[:, 0].set(jnp.arange(40_000.0))
    found = jax.jit(jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2)))(rows)
    np.testing.assert_allclose(found, np.arange(40_000.0) ** 2, rtol=1e-6)


def test_a_wrong_engine_is_noticed():
    reference = make_env("walker2d", physics="c")
    wrong = make_env("walker2d", physics="c", frame_skip=3)
    states, actions = engine_parity.reference_states(reference, 6, 5, seed=0)
    expected = engine_parity.one_step(reference, states, actions)
    assert engine_parity.compare(reference, expected, engine_parity.one_step(reference, states, actions)).is_within
    assert not engine_parity.compare(reference, expected, engine_parity.one_step(wrong, states, actions)).is_within


@pytest.mark.slow
def test_the_command_prints_a_table(capsys):
    assert command_here("parity", "physics=jax", "env=inverted_pendulum", "num_envs=6", "steps=20") == 0
    printed = capsys.readouterr()
    assert "inverted_pendulum v5, jax on cpu: 120 steps\n  qpos " in printed.out
    assert " 0 mismatches; 0 overflows, 0 not finite\n" in printed.out and printed.err == "within tolerance\n"


def test_copies_is_read_as_num_envs_with_one_warning():
    with (
        pytest.warns(UserWarning, match="copies is now num_envs") as warned,
        pytest.raises(UserError, match="num_envs=2:"),
    ):
        parity_command.main(["copies=2", "env=walker2d"])
    assert len(warned) == 1


@pytest.mark.parametrize("physics", slow_except(["warp"], ["jax", "warp"]))
def test_reset_observation_equals_the_c_engine(physics):
    keys = jax.random.split(jax.random.PRNGKey(0), 4)
    expected = jax.vmap(make_env("humanoid", physics="c").reset)(keys)
    found = jax.jit(jax.vmap(make_env("humanoid", physics=physics).reset))(keys)
    np.testing.assert_allclose(found.obs, expected.obs, rtol=2e-5, atol=2e-5)
    np.testing.assert_array_equal(found.obs[:, :22], expected.physics.qpos[:, 2:])  # the raw quaternion
    np.testing.assert_array_equal(found.obs[:, -78:], 0.0)  # no contact forces at reset


@pytest.mark.slow
def test_warp_overflow_is_reported(monkeypatch):
    def overflows():
        task = make_env("humanoid_standup", physics="warp")
        states = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(0), 2))

        def one(state, _):
            state = jax.vmap(task.step)(state, jnp.zeros((2, 17)))
            return state, state.metrics["overflow"].sum()

        return jax.jit(lambda state: jax.lax.scan(one, state, length=20)[1].max())(states)

    assert overflows() == 0
    for buffers in ({"CONSTRAINTS_PER_ENV": 8}, {"CONTACTS_PER_ENV": 0, "SPARE_CONTACTS": 20}):
        with monkeypatch.context() as patched:
            for name, size in buffers.items():
                patched.setattr(mjx_warp, name, size)
            assert overflows() == 2, buffers


def test_overflows_and_broken_steps_are_counted(monkeypatch):
    task = make_env("inverted_pendulum", physics="c")
    assert take_random_steps(task, num_envs=2, num_steps=501, seed=0) == (1000, 0, 0)
    step = task.engine.step

    def breaks(state, ctrl):
        state, derived, overflow = step(state, ctrl)
        return state._replace(qpos=jnp.where(ctrl > 0, jnp.nan, state.qpos)), derived, jnp.ones_like(overflow)

    monkeypatch.setattr(task.engine, "step", breaks, raising=False)
    num_steps, overflows, nonfinite = take_random_steps(task, num_envs=2, num_steps=1, seed=0)
    assert overflows == num_steps == 500
    assert 150 < nonfinite < 350  # half of the actions
