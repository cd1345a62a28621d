"""Randomized physics: every draw equals a C model edited by hand, on each engine. Switched off, it leaves no trace."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import TINY_CALL, leaves, slow_except, train, train_here

from mjx_walk.envs import make_env
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.randomization.edits import scale_strength
from mjx_walk.envs.randomization.model_pool import change_model
from mjx_walk.envs.randomization.options import PRESETS
from mjx_walk.settings.config import load_config
from mjx_walk.utils.errors import UserError

MODELS = {
    "friction": (0.5, 1.5),
    "mass": (0.7, 1.3),
    "center_of_mass": 0.03,
    "torque": (0.7, 1.3),
    "damping": (0.5, 1.5),
    "num_models": 16,
}


def stepped_in_c(task, physics, controls, index=None):
    """Velocity after MuJoCo has stepped the original model, or draw `index`, with a control for each physics step."""
    model = copy.copy(task.model)
    if index is not None:
        change_model(model, task.options.randomize, np.random.default_rng(index))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = physics.qpos, physics.qvel, physics.qacc_warmstart
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    return data.qvel


@pytest.mark.parametrize("engine", slow_except(["c"], ["c", "jax", "warp"]))
def test_each_draw_equals_a_model_edited_by_hand(engine):
    """The robot lies on the floor, so that contacts, motors and joint limits act."""
    task = make_env("walker2d", physics=engine, randomize=MODELS)
    qpos = task.init_qpos.at[1].set(0.1).at[2].set(1.5)
    keys = jax.random.split(jax.random.PRNGKey(0), 8)
    states = jax.jit(jax.vmap(lambda key: task.reset_to(qpos, task.init_qvel, key=key)))(keys)
    actions = jax.random.uniform(jax.random.PRNGKey(1), (8, task.action_size), minval=-1.0, maxval=1.0)
    found = jax.jit(jax.vmap(task.step))(states, actions).physics
    indices = np.asarray(states.physics.model_index)
    assert len(set(indices)) > 3
    np.testing.assert_array_equal(found.model_index, indices)
    for i, index in enumerate(indices):
        before = jax.tree.map(lambda x, i=i: x[i], states.physics)
        controls = [actions[i]] * task.num_substeps()
        edited, original = (stepped_in_c(task, before, controls, which) for which in (index, None))
        np.testing.assert_allclose(found.qvel[i], edited, rtol=1e-4, atol=1e-3)
        assert np.abs(found.qvel[i] - original).max() > 0.05


def test_models_are_the_same_whatever_their_number():
    few, more = (make_env("walker2d", "c", randomize=MODELS | {"num_models": n}).randomizer.models for n in (2, 4))
    np.testing.assert_array_equal(few["body_mass"], more["body_mass"][:2])
    assert {"body_invweight0", "body_subtreemass", "dof_invweight0"} <= few.keys()


def test_a_muscle_keeps_its_curve():
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="j" range="-1 1"/><geom size=".1"/>
        </body></worldbody><actuator><muscle joint="j" force="10"/><position joint="j" kp="4"/></actuator></mujoco>""")
    before = model.actuator_gainprm.copy()
    scale_strength(model, 2.0)
    assert model.actuator_gainprm[0, 2] == 20 and model.actuator_biasprm[0, 2] == 20
    others = np.delete(np.arange(before.shape[1]), [2, 3])
    np.testing.assert_array_equal(model.actuator_gainprm[0, others], before[0, others])
    assert model.actuator_gainprm[1, 0] == 8 and model.actuator_biasprm[1, 1] == -8


@pytest.mark.parametrize("engine", slow_except(["c"], ["c", "jax", "warp"]))
@pytest.mark.parametrize("late", [0, 1, 4, 6])
def test_latency_is_exact_to_a_physics_step(engine, late):
    """Walker2d has four physics steps of 2 ms in a step."""
    task = make_env("walker2d", physics=engine, randomize={"latency": (late * 0.002, late * 0.002)})
    state = task.reset(jax.random.PRNGKey(0))
    actions = np.float32(np.random.default_rng(0).uniform(-1, 1, (3, task.action_size)))
    issued = np.concatenate([np.zeros((late, task.action_size)), np.repeat(actions, 4, axis=0)])
    step = jax.jit(task.step)
    for i, action in enumerate(actions):
        expected = stepped_in_c(task, state.physics, issued[4 * i : 4 * i + 4])
        state = step(state, action)
        np.testing.assert_allclose(state.physics.qvel, expected, rtol=1e-4, atol=1e-3)


def test_a_robot_is_pushed_at_the_drawn_times():
    options = {"push": 2.0, "push_seconds": (0.024, 0.04)}
    task, calm = make_env("ant", "c", randomize=options), make_env("ant", "c")
    keys = jax.random.split(jax.random.PRNGKey(0), 32)
    state, action = jax.vmap(task.reset)(keys), jnp.zeros((32, 8))
    assert set(np.asarray(state.draws.push_steps)) == {1}
    step, calm_step = jax.jit(jax.vmap(task.step)), jax.jit(jax.vmap(calm.step))
    np.testing.assert_array_equal(step(state, action).physics.qvel, calm_step(state, action).physics.qvel)
    state = step(state, action)
    pushed = np.asarray(step(state, action).physics.qvel - calm_step(state, action).physics.qvel)[:, :2]
    speeds = np.linalg.norm(pushed, axis=1)
    assert 1.5 < speeds.max() < 2.1 and 0.6 < speeds.mean() < 1.4
    assert (pushed > 0).any(axis=0).all() and (pushed < 0).any(axis=0).all()


def test_noise_has_the_given_deviation():
    task = make_env("humanoid", "c", randomize={"observation_noise": 0.1, "action_noise": 0.5})
    plain = make_env("humanoid", "c")
    key = jax.random.PRNGKey(0)
    state, calm = task.reset(key), plain.reset(key)
    np.testing.assert_allclose(np.std(state.obs - calm.obs), 0.1, rtol=0.1)
    draws = [
        task.randomizer.disturb(state.draws.replace(key=k), state.physics, jnp.zeros(17))
        for k in jax.random.split(key, 100)
    ]
    deviation = np.std([control for _, _, control in draws])
    np.testing.assert_allclose(deviation, 0.5 * 0.4, rtol=0.05)  # the motors' range is ±0.4
    first, second = task.step(state, jnp.zeros(17)), plain.step(calm, jnp.zeros(17))
    assert np.abs(first.physics.qvel - second.physics.qvel).max() > 0.01


def test_switched_off_it_leaves_no_trace():
    """Programs and checkpoints stay the same."""
    state = make_env("walker2d", "c").reset(jax.random.PRNGKey(0))
    assert state.draws is None and state.physics.model_index is None
    assert len(jax.tree.leaves(state.physics)) == 3 == len(jax.tree.leaves(PhysicsState(*state.physics[:3])))


def test_an_episode_draws_once():
    task = make_env("walker2d", "c", randomize=dataclasses.replace(PRESETS["default"], num_models=16))
    state = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(0), 16))
    after = jax.jit(jax.vmap(task.step))(state, jnp.zeros((16, 6)))
    np.testing.assert_array_equal(after.physics.model_index, state.physics.model_index)
    np.testing.assert_array_equal(after.draws.latency, state.draws.latency)
    assert len(set(np.asarray(state.draws.latency))) > 3 and state.draws.latency.max() <= 10
    assert not np.array_equal(after.draws.key, state.draws.key)


def test_a_preset_is_a_start_for_other_settings():
    config = load_config(["env=walker2d", "env.randomize=default", "env.randomize.push=0", "env.randomize.mass=[1,2]"])
    assert config.env.randomize == dataclasses.replace(PRESETS["default"], push=0.0, mass=(1.0, 2.0))


@pytest.mark.parametrize(
    ("randomize", "says"),
    [
        ("defaults", "unknown env.randomize 'defaults'; did you mean: default"),
        ({"mass": (2.0, 1.0)}, r"env\.randomize\.mass=\[2\.0, 1\.0\]: give the lower value first"),
        ({"push": 1.0}, r"env\.randomize\.push=1\.0: the robot cannot move horizontally; set it to 0"),
        ({"frictoin": (1.0, 2.0)}, r"unknown key 'env\.randomize\.frictoin'"),
    ],
)
def test_mistakes(randomize, says):
    with pytest.raises(UserError, match=says):
        make_env("reacher", "c", randomize=randomize)


def test_friction_that_an_engine_does_not_simulate_is_refused():
    with pytest.raises(UserError, match="friction"):
        make_env("walker2d", "jax", randomize={"friction": (0.01, 1.0), "num_models": 64})


@pytest.mark.parametrize("setting", ["push_seconds=[1,2]", "num_models=5"])
def test_a_setting_without_effect_is_refused(setting):
    with pytest.raises(UserError, match=r"env\.randomize\..* has no effect with env\.randomize\."):
        load_config(["env=walker2d", f"env.randomize.{setting}"])


def test_changed_models_alone_draw_nothing_in_a_step():
    state = make_env("walker2d", "c", randomize=MODELS).reset(jax.random.PRNGKey(0))
    assert state.draws is None and state.physics.model_index is not None


@pytest.mark.slow
def test_resume_is_exact(tmp_path):
    """Draws, late actions and the times of pushes are in the checkpoint."""
    settings = ("env.randomize=default", "env.randomize.num_models=16", "env.randomize.push_seconds=[0.02,0.05]")
    train_here(tmp_path / "full", *settings, f"total_steps={4 * TINY_CALL}")
    half = (f"total_steps={2 * TINY_CALL}", f"algo.schedule_steps={4 * TINY_CALL}")
    train_here(tmp_path / "halves", *settings, *half)
    train(tmp_path / "halves", "resume=true", f"total_steps={4 * TINY_CALL}", tiny=[])
    full, halves = leaves(tmp_path / "full", 4), leaves(tmp_path / "halves", 4)
    assert full.keys() == halves.keys()
    assert {"physics.model_index", "draws.past_actions"} <= {".".join(name.split(".")[-2:]) for name in full}
    for name, leaf in full.items():
        np.testing.assert_array_equal(leaf, halves[name], err_msg=name)
