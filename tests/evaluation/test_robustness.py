"""Changed physics in the real Gymnasium, and the scores of a policy under them."""

import json

import gymnasium
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import command_here

from mjx_walk.envs import make_env
from mjx_walk.envs.models import load_model
from mjx_walk.evaluation.gymnasium_scores import play_in_gymnasium, score_in_gymnasium
from mjx_walk.evaluation.perturbations import Perturbation, perturb
from mjx_walk.evaluation.robustness import measure_robustness


def changed(name, **changes):
    """A fresh environment of Gymnasium with changed physics, after its reset."""
    env = gymnasium.make(name).unwrapped
    perturb(env, Perturbation(**changes), seed=0)
    env.reset(seed=0)
    return env


def test_a_heavier_model_is_the_one_that_mujoco_compiles_from_denser_geoms():
    path = gymnasium.make("Walker2d-v5").unwrapped.fullpath
    spec = mujoco.MjSpec.from_file(path)
    for geom in spec.geoms:
        geom.density *= 1.3
    expected, model = spec.compile(), changed("Walker2d-v5", mass=1.3).model
    for name in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0"):
        np.testing.assert_allclose(getattr(model, name), getattr(expected, name), rtol=1e-9, err_msg=name)
    assert model.body_subtreemass[1] == pytest.approx(1.3 * load_model("walker2d_v5.xml").body_subtreemass[1])


def test_friction_and_torque_are_factors():
    usual, model = load_model("ant.xml"), changed("Ant-v5", friction=0.5, torque=0.8).model
    np.testing.assert_allclose(model.geom_friction[:, 0], 0.5 * usual.geom_friction[:, 0])
    np.testing.assert_array_equal(model.geom_friction[:, 1:], usual.geom_friction[:, 1:])
    data, ours = mujoco.MjData(usual), mujoco.MjData(model)
    for each, own in ((data, usual), (ours, model)):
        each.ctrl[:] = 0.7
        mujoco.mj_forward(own, each)
    np.testing.assert_allclose(ours.qfrc_actuator, 0.8 * data.qfrc_actuator)


@pytest.mark.parametrize(("seconds", "late"), [(0.002, 1), (0.01, 5), (0.02, 10)])
def test_a_late_action_reaches_the_motors_after_physics_steps(seconds, late):
    """`late` physics steps of 2 ms, four of which are one step of the walker."""
    env = changed("Walker2d-v5", latency=seconds)
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = env.data.qpos, env.data.qvel
    mujoco.mj_forward(env.model, data)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    controls = [np.zeros(6)] * late + [action for action in actions for _ in range(env.frame_skip)]
    for step, action in enumerate(actions):
        env.step(action)
        for control in controls[step * env.frame_skip : (step + 1) * env.frame_skip]:
            data.ctrl[:] = control
            mujoco.mj_step(env.model, data)
        np.testing.assert_array_equal(env.data.qpos, data.qpos)


def velocity_of_the_center(env):
    mujoco.mj_subtreeVel(env.model, env.data)
    return env.data.subtree_linvel[1].copy()


@pytest.mark.parametrize(("name", "axes"), [("Humanoid-v5", 2), ("Walker2d-v5", 1)])
def test_a_push_moves_the_center_of_mass(name, axes):
    env, usual = changed(name, push=0.7), changed(name)
    action = np.zeros(env.model.nu)
    steps = 0
    for each in (env, usual):  # above the ground, where nothing but the push makes a difference
        each.data.qpos[1 if axes == 1 else 2] += 50.0
        mujoco.mj_forward(each.model, each.data)
    while env.data.time < 2.0:
        for each in (env, usual):
            each.step(action)
        np.testing.assert_array_equal(env.data.qvel, usual.data.qvel)
        steps += 1
    before = velocity_of_the_center(env)
    env.do_simulation(action, 0)
    mujoco.mj_forward(env.model, env.data)
    change = velocity_of_the_center(env) - before
    mujoco.mj_forward(usual.model, usual.data)
    assert steps > 100
    assert np.linalg.norm(change[:axes]) == pytest.approx(0.7, abs=2e-3)
    assert np.abs(change[axes:]).max() < 2e-3


def test_no_change_is_gymnasium():
    task = make_env("hopper", physics="c")
    scores = score_in_gymnasium(task, lambda obs: jnp.tanh(obs[:, :3]), 3, seed=5)
    env = gymnasium.make("Hopper-v5")
    for seed, total in zip((5, 6, 7), scores.returns, strict=True):
        obs, _ = env.reset(seed=seed)
        expected, is_over = 0.0, False
        while not is_over:
            obs, reward, terminated, truncated, _ = env.step(np.asarray(jnp.tanh(jnp.float32(obs[None, :3])))[0])
            expected, is_over = expected + reward, terminated or truncated
        assert total == pytest.approx(expected)
    stronger = play_in_gymnasium(task, lambda obs: jnp.tanh(obs[:, :3]), [5, 6, 7], [Perturbation(mass=2.0)] * 3)
    assert (stronger[0] != scores.returns).all()


def test_the_command_scores_26_cells(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command_here("eval", "run=zoo:inverted_pendulum-csac", "robustness=true", "episodes=2") == 0
    said = capsys.readouterr().out
    assert "InvertedPendulum-v5, mean return of 2 episodes a cell:\n  nominal       1,000.0\n" in said
    saved = json.loads((tmp_path / "inverted_pendulum-csac.json").read_text())
    assert len(saved["cells"]) == 26 and all(len(cell["returns"]) == 2 for cell in saved["cells"])
    single = [np.mean(cell["returns"]) for cell in saved["cells"] if cell["name"] != "all"]
    assert saved["area"] == pytest.approx(np.mean(single)) and f"{saved['area']:,.1f}, " in said
    worst = min(saved["cells"], key=lambda cell: np.mean(cell["returns"]))
    assert f"Worst cell: {worst['name']} {worst['label']}, " in said
    assert (tmp_path / "inverted_pendulum-csac.png").stat().st_size > 10_000


def test_a_task_that_gymnasium_lacks_is_refused():
    class Own(type(make_env("hopper", physics="c"))):
        pass

    task = Own(make_env("hopper", physics="c").options, "c")
    with pytest.raises(ValueError, match="robustness=true plays in Gymnasium, which has no equivalent of hopper"):
        measure_robustness(task, None, 1)
