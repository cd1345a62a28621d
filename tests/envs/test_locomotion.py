"""The task of a robot that follows commanded velocities: observation, commands, reward, falls, and its engines."""

import importlib.util
import json
import re
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest
from helpers import CLONE, OPTIMIZED, TINY, TINY_CALL, command_here, leaves, train_here
from scipy.spatial.transform import Rotation
from small_robot import small_robot, write

import mjx_walk
from mjx_walk.envs import make_env
from mjx_walk.evaluation import engine_parity
from mjx_walk.evaluation.gymnasium_scores import compile_episodes, score_in_gymnasium, score_in_sim
from mjx_walk.storage.scores import read_scores
from mjx_walk.utils.errors import UserError

SERVOS, FEET = 8, 4
LINE = r" *turning error \(rad/s\): [\d.]+, velocity error \(m/s\): [\d.]+, falls \(%\): [\d.]+"
_SPEC = importlib.util.spec_from_file_location("run_robot", CLONE / "docs" / "examples" / "run_robot.py")
run_robot = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(run_robot)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """The model of a small quadruped."""
    return write(tmp_path_factory.mktemp("robot"), small_robot())


@pytest.fixture(scope="module")
def task(path):
    return make_env("locomotion", physics="c", xml_file=path)


@pytest.fixture(scope="module")
def step(task):
    return jax.jit(task.step)


def at(task, height=0.0, rotation=None, velocity=None):
    """A state in the standing pose, higher by some m, turned by a rotation, and moving at a velocity `[6]`."""
    qpos = np.array(task.init_qpos)
    qpos[2] += height
    if rotation is not None:
        qpos[3:7] = rotation.as_quat(scalar_first=True)
    qvel = np.zeros(task.model.nv)
    qvel[:6] = 0.0 if velocity is None else velocity
    return task.reset_to(qpos, qvel)


def stand(task):
    """The action that holds the standing pose."""
    return (task.action_low + task.action_high) / 2


def test_the_observation_is_what_a_robot_senses(task):
    rotation = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])
    state = at(task, rotation=rotation, velocity=[1, 2, 3, 0.4, 0.5, 0.6])
    assert (task.observation_size, task.action_size, task.dt) == (12 + 3 * SERVOS - 3, SERVOS, pytest.approx(0.02))
    gyro, gravity, positions, velocities, last, command = np.split(
        np.asarray(state.obs), np.cumsum(list(task.observation_blocks().values()))[:-1]
    )
    np.testing.assert_allclose(gyro, [0.4, 0.5, 0.6], rtol=1e-6)
    np.testing.assert_allclose(gravity, rotation.inv().apply([0, 0, -1]), atol=1e-6)
    np.testing.assert_allclose(positions, task.init_qpos[7:] - stand(task), atol=1e-6)
    np.testing.assert_array_equal(velocities, np.zeros(SERVOS))
    np.testing.assert_array_equal(last, np.zeros(SERVOS))
    np.testing.assert_array_equal(command, state.memory["command"])


def test_an_action_is_an_offset_from_the_standing_pose(task, step):
    half = task.scale_action(jnp.full(SERVOS, 0.5))
    np.testing.assert_allclose(half - stand(task), 0.25, atol=1e-6)
    after = step(at(task), half)
    np.testing.assert_allclose(after.memory["last_action"], 0.5, atol=1e-5)
    np.testing.assert_allclose(after.obs[-3 - SERVOS : -3], 0.5, atol=1e-5)


def test_commands_are_redrawn_inside_their_ranges(path):
    ranges = {"forward_range": (0.5, 1.0), "sideways_range": (-0.2, 0.0), "turning_range": (2.0, 3.0)}
    options = {"command_seconds": (0.1, 0.2), "zero_command_probability": 0.25, **ranges}
    task = make_env("locomotion", physics="c", xml_file=path, **options)
    start = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(0), 32))
    actions = jnp.tile(stand(task), (32, 1))

    def one(state, _):
        state = jax.vmap(task.step)(state, actions)
        return state, state.memory["command"]

    _, commands = jax.jit(lambda state: jax.lax.scan(one, state, None, 60))(start)
    commands = np.concatenate([start.memory["command"][None], commands])
    is_zero = (commands == 0).all(-1)
    for values, (low, high) in zip(np.moveaxis(commands, -1, 0), ranges.values(), strict=True):
        assert (low <= values[~is_zero]).all() and (values[~is_zero] <= high).all() and np.ptp(values[~is_zero]) > 0.15
    assert 0.15 < is_zero.mean() < 0.35
    changes = (commands[1:] != commands[:-1]).any(-1).sum()
    assert 32 * 60 / 10 * 0.85 < changes < 32 * 60 / 5  # every 5 to 10 steps, except from zero to zero
    assert len({*map(tuple, commands[0])}) > 20  # other keys, other commands


def test_the_reward_is_the_weighted_sum_of_its_terms(task, step):
    """Each term by hand, from the state after the step."""
    rotation = Rotation.from_euler("xyz", [0.1, 0.2, 0.7])
    before = at(task, height=0.3, rotation=rotation, velocity=[0.5, -0.3, 0.2, 0.3, -0.2, 0.4])
    after = step(before, stand(task) + 0.1)
    turned = Rotation.from_quat(after.physics.qpos[3:7], scalar_first=True)
    local, angular = turned.inv().apply(after.physics.qvel[:3]), np.asarray(after.physics.qvel[3:6])
    gravity, offsets = turned.inv().apply([0, 0, -1]), np.asarray(after.physics.qpos[7:] - stand(task))
    command = np.asarray(before.memory["command"])
    expected = {
        "reward_linear_velocity": np.exp(-np.square(command[:2] - local[:2]).sum() / 0.25),
        "reward_angular_velocity": 0.5 * np.exp(-np.square(command[2] - angular[2]) / 0.25),
        "reward_pose": 0.5 * np.exp(-4 * np.square(offsets).mean()),
        "reward_vertical_velocity": -0.5 * after.physics.qvel[2] ** 2,
        "reward_roll_and_pitch": -0.05 * np.square(angular[:2]).sum(),
        "reward_orientation": -5.0 * np.square(gravity[:2]).sum(),
        "reward_action_rate": -0.01 * SERVOS * 0.2**2,
        "reward_air_time": 0.0,
        "reward_joint_limits": 0.0,
        "reward_termination": 0.0,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(after.metrics[name], value, rtol=1e-4, atol=1e-6, err_msg=name)
    assert task.reward_terms == tuple(f"reward_{field}" for field in vars(task.options.weights))
    assert after.metrics["reward_torques"] < 0
    total = sum(float(after.metrics[name]) for name in task.reward_terms)
    np.testing.assert_allclose(after.reward, max(total, 0.0), rtol=1e-5)


def test_weights_are_settings_and_the_reward_is_at_least_zero(path):
    weights = {"orientation": -1000.0, "pose": 0.0}
    task = make_env("locomotion", physics="c", xml_file=path, weights=weights)
    after = task.step(at(task, height=0.3, rotation=Rotation.from_euler("x", 0.5)), stand(task))
    assert after.metrics["reward_orientation"] < -100 and after.metrics["reward_pose"] == 0 == after.reward


def test_feet_in_the_air_are_timed_and_rewarded_on_landing(task, step):
    state = at(task, height=0.25)
    rewards, times = [], []
    for _ in range(20):
        state = step(state, stand(task))
        rewards.append(float(state.metrics["reward_air_time"]))
        times.append(np.asarray(state.memory["air_time"]))
    landed = next(i for i, time in enumerate(times) if (time == 0).any())
    np.testing.assert_allclose(times[landed - 1], landed * task.dt, rtol=1e-5)
    assert 0.18 < landed * task.dt < 0.28 and not any(rewards[:landed])  # a fall of 0.25 m takes 0.226 s
    num_landed = (times[landed] == 0).sum()
    np.testing.assert_allclose(rewards[landed], 0.1 * num_landed * ((landed + 1) * task.dt - 0.1), rtol=1e-5)


def test_episodes_end_on_a_fall_and_not_at_the_time_limit(path):
    task = make_env("locomotion", physics="c", xml_file=path, max_episode_steps=30)
    step, state = jax.jit(task.step), at(task)
    for _ in range(30):
        state = step(state, stand(task))
        assert not state.terminated
    assert state.truncated and state.metrics["reward_termination"] == 0
    tilted = step(at(task, height=0.5, rotation=Rotation.from_euler("y", 75, degrees=True)), stand(task))
    assert tilted.terminated and tilted.metrics["reward_termination"] == -1
    assert not step(at(task, height=0.5, rotation=Rotation.from_euler("y", 60, degrees=True)), stand(task)).terminated
    lying = task.init_qpos.at[2].set(0.029).at[jnp.arange(7, 15, 2)].set(1.5).at[jnp.arange(8, 15, 2)].set(-0.5)
    assert step(task.reset_to(lying, task.init_qvel), stand(task)).terminated  # upright, with the trunk on the floor


def test_resets_differ_in_heading_and_velocity(task):
    states = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.PRNGKey(0), 200))
    heading = Rotation.from_quat(states.physics.qpos[:, 3:7], scalar_first=True).as_euler("ZYX")
    assert np.ptp(heading[:, 0]) > 6 and np.abs(heading[:, 1:]).max() < 0.05
    assert 0.45 < np.abs(states.physics.qvel[:, :6]).max() <= 0.5 and (states.physics.qvel[:, 6:] == 0).all()
    assert not states.terminated.any()


def test_what_needs_a_model_says_so(path):
    with pytest.raises(UserError, match=r"locomotion has no model of its own; give .* a robot: env\.xml_file=PATH"):
        make_env("locomotion", physics="c")
    with pytest.raises(UserError, match="locomotion has no equivalent in Gymnasium, so it has no v4"):
        make_env("locomotion", physics="c", xml_file=path, version="v4")
    with pytest.raises(UserError, match=r"unknown key 'env\.motors\.kq'"):
        make_env("locomotion", physics="c", xml_file=path, motors={"kq": 1.0})
    with pytest.raises(UserError, match=r"Gymnasium has no equivalent of locomotion; step it with mjx_walk\.make_env"):
        gymnasium.make("mjx_walk/Walker2d-v5", env="locomotion", xml_file=path)


def test_a_run_is_trained_resumed_scored_and_exported(tmp_path, monkeypatch, path, capsys):
    """A resumed run equals an uninterrupted one bit for bit, with the commands and the keys of its environments."""
    monkeypatch.chdir(tmp_path)
    settings = ["env=locomotion", f"env.xml_file={path}", "env.command_seconds=[0.02,0.1]", "env.weights.pose=0.4"]
    settings.append(f"algo.schedule_steps={4 * TINY_CALL}")
    for folder, steps in (("whole", 4), ("parts", 2)):
        train_here(folder, *settings, f"total_steps={steps * TINY_CALL}", tiny=TINY[1:])
    train_here("parts", "resume=true", f"total_steps={4 * TINY_CALL}", tiny=[])
    whole, parts = (leaves(tmp_path / folder, 4) for folder in ("whole", "parts"))
    assert whole.keys() == parts.keys() and sum("command" in name for name in whole) >= 2
    for name, leaf in whole.items():
        np.testing.assert_array_equal(leaf, parts[name], err_msg=name)
    assert command_here("eval", "run=parts", "episodes=2") == 0
    *_, score, measures, _ = capsys.readouterr().out.splitlines()
    assert "locomotion on c" in score and re.fullmatch(LINE, measures)
    block = read_scores(tmp_path / "parts" / "eval_gymnasium.json").block("final")
    assert {len(values) for values in block["measures"].values()} == {2}
    assert command_here("export", "run=parts", "format=onnx", "out=policy.onnx") == 0
    facts = {prop.key: prop.value for prop in onnx.load(tmp_path / "policy.onnx").metadata_props}
    keywords = json.loads(facts["keywords"])
    assert keywords["weights"]["pose"] == 0.4 and keywords["xml_file"] == Path(path).name
    assert facts["task"] == "locomotion" and len(json.loads(facts["motors"])) == SERVOS
    assert json.loads(facts["command_ranges"])["sideways"] == [-0.5, 0.5]
    assert_program_equals(mjx_walk.load_run("parts", "c"), "policy.onnx", path)


def assert_program_equals(run, policy_path, model_path):
    """The example of the documentation gives the observations and states of the task."""
    task, command = run.task, np.array([0.5, -0.2, 0.3], np.float32)
    state = task.reset_to(task.init_qpos, task.init_qvel)
    state = state.replace(memory=state.memory | {"command": command, "command_steps": np.int32(100)})
    state, step = state.replace(obs=state.obs.at[-3:].set(command)), jax.jit(task.step)
    for obs, data in run_robot.walk(policy_path, model_path, command, num_steps=25):
        np.testing.assert_allclose(obs, state.obs, atol=1e-3)
        state = step(state, run.policy(state.obs))
        np.testing.assert_allclose(data.qpos, state.physics.qpos, atol=1e-4)
    assert np.abs(state.obs[6 : 6 + SERVOS]).max() > 0.01  # it moved


ACTUATORS = ("", 'motor gear="3" ctrlrange="-5 5"', 'position kp="20" kv="0.5" ctrlrange="-2 2"')


@pytest.mark.parametrize("actuator", ACTUATORS)
def test_the_example_program_simulates_the_robot_of_the_task(tmp_path, actuator):
    """A file without motors, with torques, and with servos of its own."""
    xml = write(tmp_path, small_robot(actuator=actuator))
    task = make_env("locomotion", physics="c", xml_file=xml)
    found = run_robot.load_model(xml, json.loads(json.dumps(task.export_metadata())))
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange", "actuator_gear"):
        np.testing.assert_array_equal(getattr(found, name), getattr(task.model, name), err_msg=name)
    for name in ("actuator_forcelimited", "actuator_trnid", "dof_armature", "body_mass", "geom_type", "geom_contype"):
        np.testing.assert_array_equal(getattr(found, name), getattr(task.model, name), err_msg=name)


def test_errors_are_those_of_the_command_under_which_the_robot_acted(task, step):
    rotation = Rotation.from_euler("xyz", [0.1, 0.2, 0.7])
    before = at(task, height=0.3, rotation=rotation, velocity=[0.5, -0.3, 0.2, 0.3, -0.2, 0.4])
    before = before.replace(memory=before.memory | {"command": jnp.array([1.0, 0.5, -1.0]), "command_steps": 0})
    after = step(before, stand(task))
    assert (after.memory["command"] != before.memory["command"]).any()
    found = task.measures(before, after)
    local = Rotation.from_quat(after.physics.qpos[3:7], scalar_first=True).inv().apply(after.physics.qvel[:3])
    np.testing.assert_allclose(found["velocity error (m/s)"], np.hypot(local[0] - 1.0, local[1] - 0.5), rtol=1e-4)
    np.testing.assert_allclose(found["turning error (rad/s)"], after.physics.qvel[5] + 1.0, rtol=1e-5)


def test_scores_hold_the_means_of_the_errors_and_the_falls(path):
    """One robot stands until the time limit; the others fall when they are let go, each after some steps."""
    task = make_env("locomotion", physics="c", xml_file=path, max_episode_steps=40, zero_command_probability=1.0)

    def policy(obs, key):
        falls = jnp.arange(len(obs))[:, None] > 0
        return jnp.where(falls, stand(task) + jnp.tile(jnp.array([3.0, 0.0]), 4), stand(task))

    scores = score_in_sim(task, compile_episodes(task, policy), num_episodes=3)
    assert scores.lengths[0] == 40 and (scores.lengths[1:] < 40).all()
    assert scores.measures["falls (%)"].tolist() == [0, 100, 100]
    errors = scores.measures["velocity error (m/s)"]
    assert errors[0] < 0.2 and (errors[1:] > errors[0]).all() and errors.max() < 3
    assert re.fullmatch(LINE, scores.measures_line) and "falls (%): 66.7" in scores.measures_line


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["jax", "warp"])
def test_engines_agree(path, physics):
    reference, task = (make_env("locomotion", physics=name, xml_file=path) for name in ("c", physics))
    states, actions = jax.device_get(engine_parity.reference_states(reference, num_envs=24, num_steps=40, seed=0))
    stepped = jax.jit(jax.vmap(task.step), compiler_options=OPTIMIZED)(states, actions)
    found = engine_parity.compare(task, engine_parity.one_step(reference, states, actions), jax.device_get(stepped))
    assert found.is_within, "\n".join(map(str, found.errors))


def test_scores_use_the_original_physics(path):
    options = {"xml_file": path, "max_episode_steps": 20}
    plain = make_env("locomotion", physics="c", **options)
    randomized = make_env("locomotion", physics="c", randomize={"mass": (0.5, 2.0), "num_models": 4}, **options)
    scores = [
        score_in_gymnasium(task, lambda obs: jnp.tile(stand(plain), (len(obs), 1)), 3) for task in (plain, randomized)
    ]
    np.testing.assert_array_equal(scores[0].returns, scores[1].returns)
