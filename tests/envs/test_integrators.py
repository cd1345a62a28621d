"""A step of models with implicit integrators and activations equals MuJoCo's C library."""

import feature_models
import jax
import mujoco
import numpy as np
import pytest
from helpers import slow_except

from mjx_walk.envs.physics import PhysicsState, make_engine

NUM_SUBSTEPS = 5
FEATURES = (
    *("damping", "gravcomp", "fixed_damping", "free_offset", "affine", "filter_affine", "filterexact_actrange"),
    *("integrator_servo", "muscle", "servo_forcerange", "tendon_servo"),
)
"""Joints, tendons, motors and a free body with all terms of the implicit integrators. They touch the floor."""
TOLERANCE = {"c": 1e-6, "jax": 2e-5, "warp": 2e-5}
"""Largest error of a position, velocity or activation, relative to one plus its change."""


def visited(model, num_states=6):
    """States of one trajectory with float32 values, and MuJoCo's state after a step from each of them."""
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    data.qvel[:] = 2 * rng.normal(size=model.nv)
    states, controls, after = [], [], []
    for _ in range(num_states):
        states.append(state_of(data))
        controls.append(np.float32(rng.uniform(-2, 2, model.nu)))
        load(data, states[-1])
        data.ctrl[:] = controls[-1]
        mujoco.mj_step(model, data, nstep=NUM_SUBSTEPS)
        after.append(state_of(data))
    states, after = (jax.tree.map(lambda *x: np.stack(x), *each) for each in (states, after))
    return states, np.stack(controls), after


def state_of(data):
    arrays = [np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart)]
    return PhysicsState(*arrays, np.float32(data.act) if data.act.size else None)


def load(data, state):
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:], act = state[:4]
    if act is not None:
        data.act[:] = act


def assert_equal_steps(model, engine):
    states, controls, expected = visited(model)
    found = jax.jit(jax.vmap(make_engine(engine, model, NUM_SUBSTEPS, ()).step))(states, controls)[0]
    assert found.act is None or np.abs(expected.act - states.act).max(axis=0).min() > 1e-3
    for name in ("qpos", "qvel", "act")[: 3 if model.na else 2]:
        before, after, ours = (np.asarray(getattr(state, name)) for state in (states, expected, found))
        error = np.abs(ours - after) / (1 + np.abs(after - before))
        assert error.max() < TOLERANCE[engine], (name, error.max(axis=0))


CASES = [
    *(f"c {integrator}" for integrator in ("implicit", "implicitfast", "Euler", "RK4")),
    *("jax implicitfast", "jax RK4", "warp implicitfast"),
]


@pytest.mark.parametrize("case", slow_except(["c implicit"], CASES))
def test_a_step_equals_mujocos(case):
    engine, integrator = case.split()
    assert_equal_steps(feature_models.load(*FEATURES, option=f'integrator="{integrator}"'), engine)
