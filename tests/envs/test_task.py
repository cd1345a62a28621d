"""The contract of a task: purity, vmap, the finiteness check, shapes, and errors for invalid options."""

import copy
import pickle
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import jaxtyping
import mujoco
import numpy as np
import pytest
from shapes import check_shapes
from toy_tasks import MountainCar

from mjx_walk.envs import GYMNASIUM_TASKS, TASKS, TrainableTask, make_env
from mjx_walk.envs.physics import base
from mjx_walk.envs.walker2d import Walker2d, Walker2dOptions
from mjx_walk.machine.quiet_mujoco import hide_deprecations
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.episode import make_gymnasium


def test_vmap_equals_separate_steps():
    task = make_env("walker2d", physics="c")
    states = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(0), 20))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (20, 6), minval=-1, maxval=1)
    together = jax.vmap(task.step)(states, actions)
    for i in (0, 7, 19):
        alone = task.step(jax.tree.map(lambda x, i=i: x[i], states), actions[i])
        jax.tree.map(np.testing.assert_array_equal, alone, jax.tree.map(lambda x, i=i: x[i], together))


def test_threads_may_step_one_task():
    task = make_env("hopper", physics="c")
    step = jax.jit(jax.vmap(task.step))
    start = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(0), 32))  # enough for several MuJoCo threads

    def roll_out(seed):
        state = start
        for key in jax.random.split(jax.random.PRNGKey(seed), 60):
            state = step(state, jax.random.uniform(key, (32, 3), minval=-1, maxval=1))
        return state

    in_turn = [roll_out(seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        at_once = list(pool.map(roll_out, range(4)))
    jax.tree.map(np.testing.assert_array_equal, in_turn, at_once)


@pytest.mark.parametrize("make", [lambda: make_env("walker2d", physics="c"), MountainCar])
def test_tasks_have_the_attributes_that_trainers_need(make):
    task = make()
    assert all(hasattr(task, name) for name in TrainableTask.__annotations__)
    np.testing.assert_array_equal(task.scale_action(2.0 * task.action_high), task.action_high)


def test_nested_vmap_calls_a_batched_function_once():
    sizes = []

    def batch(x):
        sizes.append(x.shape)
        return 2 * x

    doubled = jax.vmap(jax.vmap(base.batch_once(batch)))(jnp.ones((3, 4, 5)))
    assert doubled.shape == (3, 4, 5) and sizes[-1] == (12, 5)
    empty = jax.vmap(jax.vmap(base.batch_once(batch)))(jnp.ones((3, 4, 0)))  # a model without motors
    assert empty.shape == (3, 4, 0) and sizes[-1] == (12, 0)


@pytest.mark.parametrize("name", GYMNASIUM_TASKS)
def test_nonfinite_physics_terminates_and_is_not_returned(name):
    task = make_env(name, physics="c")
    good = task.reset(jax.random.PRNGKey(0))
    broken = good.replace(physics=good.physics._replace(qvel=good.physics.qvel.at[0].set(jnp.nan)))
    after = task.step(broken, jnp.zeros(task.action_size))
    assert bool(after.terminated) and after.metrics["nonfinite"] == 1
    np.testing.assert_array_equal(after.obs, good.obs)
    assert after.reward == 0 and all(np.isfinite(value) for value in after.metrics.values())
    finite = task.step(good, jnp.zeros(task.action_size))
    assert finite.metrics["nonfinite"] == 0 and not bool(finite.terminated)


def test_velocities_beyond_mujocos_limit_count_as_nonfinite():
    """Beyond 1e10, MuJoCo resets its simulation."""
    task = make_env("walker2d", physics="c")
    state, step = task.reset(jax.random.PRNGKey(0)), task.engine.step
    for excess, is_broken in ((0.9e10, False), (1.1e10, True)):
        task.engine.step = lambda *args, excess=excess: _faster(step(*args), excess)
        after = task.step(state, jnp.zeros(6))
        assert after.metrics["nonfinite"] == is_broken and bool(after.terminated) >= is_broken
        assert (after.reward == 0) == is_broken


def _faster(stepped, excess):
    physics, *rest = stepped
    return physics._replace(qvel=physics.qvel.at[-1].add(excess)), *rest


def test_nan_actions_count_as_nonfinite():
    task = make_env("humanoid", physics="c")
    state = task.reset(jax.random.PRNGKey(0))
    after = task.step(state, jnp.full(17, jnp.nan))
    assert after.metrics["nonfinite"] == 1 and np.isfinite(after.obs).all() and np.isfinite(after.reward)


def test_state_holds_no_derived_arrays():
    task = make_env("humanoid", physics="c")
    state = task.reset(jax.random.PRNGKey(0))
    assert sum(x.size for x in jax.tree.leaves(state)) < task.observation_size + 100


class Chaser(Walker2d):
    """Walker2d that observes a target, which is drawn at the reset and moves by the first action in each step."""

    def observation_blocks(self):
        return super().observation_blocks() | {"target": 1}

    def observe_all(self, physics, derived, carry):
        return jnp.append(self.observe(physics, derived), carry["target"])

    def initial_carry(self, key, physics, derived):
        return {"target": jax.random.uniform(key)}

    def next_carry(self, before, physics, derived, action):
        return {"target": before.memory["target"] + action[0]}


def test_a_carry_may_be_random_and_depend_on_the_former_one():
    task, plain = Chaser(Walker2dOptions(name="walker2d"), "c"), make_env("walker2d", physics="c")
    keys = jax.random.split(jax.random.PRNGKey(0), 5)
    states, expected = jax.vmap(task.reset)(keys), jax.vmap(plain.reset)(keys)
    np.testing.assert_array_equal(states.obs[:, :-1], expected.obs)
    np.testing.assert_array_equal(states.obs[:, -1], states.memory["target"])
    assert len(np.unique(states.memory["target"])) == 5
    actions = jnp.full((5, 6), 0.25)
    after = jax.vmap(task.step)(states, actions)
    np.testing.assert_allclose(after.obs[:, -1], states.memory["target"] + 0.25, rtol=1e-6)
    np.testing.assert_array_equal(after.reward, jax.vmap(plain.step)(expected, actions).reward)
    qpos, qvel = states.physics.qpos[0], states.physics.qvel[0]
    assert task.reset_to(qpos, qvel).obs[-1] == task.reset_to(qpos, qvel, key=jax.random.PRNGKey(0)).obs[-1]
    assert task.reset_to(qpos, qvel).obs[-1] != task.reset_to(qpos, qvel, key=jax.random.PRNGKey(1)).obs[-1]


@pytest.mark.parametrize("name", GYMNASIUM_TASKS)
def test_shapes_equal_the_annotations(name, monkeypatch):
    methods = (
        "reset",
        "initial_state",
        "reset_to",
        "step",
        "carry",
        "observe",
        "reward_and_termination",
        "scale_action",
    )
    check_shapes(monkeypatch, TASKS[name][0], *methods)
    task = make_env(name, physics="c")
    states = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    actions = task.scale_action(jnp.ones((3, task.action_size)))
    jax.vmap(task.step)(states, actions)
    with pytest.raises(jaxtyping.TypeCheckError, match="qpos"):
        task.reset_to(task.init_qpos.reshape(1, -1), task.init_qvel)


@pytest.mark.parametrize("name", GYMNASIUM_TASKS)
def test_actions_are_scaled_to_gymnasiums_units(name):
    task = make_env(name, physics="c")
    np.testing.assert_array_equal(task.scale_action(jnp.full(task.action_size, -2.0)), task.action_low)
    np.testing.assert_array_equal(task.scale_action(jnp.ones(task.action_size)), task.action_high)
    actions = jax.random.uniform(jax.random.PRNGKey(0), (3, 2, task.action_size), minval=-1.5, maxval=1.5)
    center, half_range = (task.action_high + task.action_low) / 2, (task.action_high - task.action_low) / 2
    expected = np.float32(center + half_range * np.clip(actions, -1.0, 1.0))
    np.testing.assert_array_equal(task.scale_action(actions), expected)


@pytest.mark.parametrize(
    ("kwargs", "says"),
    [
        ({"name": "snake"}, f"unknown env 'snake'; choose one of: {', '.join(TASKS)}"),
        ({"version": "v3"}, "choose one of: v5, v4"),
        ({"physics": "bullet"}, "choose one of: auto, warp, jax, c"),
        ({"healthy_rewad": 1.0}, "did you mean 'healthy_reward'?"),
        ({"xml_file": "no_such.xml"}, "model file not found"),
        ({"frame_skip": 0}, "must be at least 1"),
        (
            {"name": "pusher", "version": "v4"},
            "Gymnasium supports Pusher-v4 only with MuJoCo below 3; choose one of: v5",
        ),
        ({"name": "ant", "use_contact_forces": True}, "ant v5 does not take use_contact_forces; use version=v4"),
        ({"name": "ant", "main_body": "head"}, "no body 'head', which the task reads; its bodies: world, torso"),
        ({"name": "ant", "main_body": 99}, "the model has no body '99'"),
        ({"name": "reacher", "xml_file": "hopper.xml"}, "the model has no body 'fingertip'"),
        ({"name": "reacher", "reset_noise_scale": 0.1}, "reacher has no option 'reset_noise_scale'"),
        ({"name": "humanoid", "version": "v4", "include_cvel_in_observation": False}, "does not take include_cvel"),
    ],
)
def test_invalid_options_are_refused(kwargs, says):
    with pytest.raises(UserError, match=says.replace("?", r"\?")):
        make_env(**({"name": "walker2d", "physics": "c"} | kwargs))


def test_custom_model_file(tmp_path):
    source = Path(gymnasium.__path__[0]) / "envs" / "mujoco" / "assets" / "walker2d_v5.xml"
    text = source.read_text().replace('timestep="0.002"', 'timestep="0.001"')
    path = tmp_path / "custom.xml"
    path.write_text(text)
    task = make_env("walker2d", physics="c", xml_file=str(path))
    assert task.dt == pytest.approx(0.004)
    assert task.gymnasium_kwargs() == {"xml_file": str(path)}


def test_loading_models_prints_no_deprecations(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings(action="error", category=UserWarning):
        task = make_env("half_cheetah", physics="c")
    make_gymnasium(task).close()
    printed = capfd.readouterr()
    assert printed.out == printed.err == "" and not list(tmp_path.iterdir())
    with pytest.warns(UserWarning, match="a warning of another kind"), hide_deprecations():
        mujoco.get_mju_user_warning()("a warning of another kind")
    assert mujoco.get_mju_user_warning() is None


@pytest.mark.parametrize("physics", ["c", "jax"])
def test_a_wrong_action_is_refused_while_the_step_is_traced(physics):
    env = make_env("walker2d", physics)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    for shape in ((), (1,), (5,), (1, 6)):
        with pytest.raises(ValueError, match="Action dimension mismatch"):
            jax.eval_shape(env.step, state, jax.ShapeDtypeStruct(shape, jnp.float32))


def test_a_task_can_be_copied_and_pickled():
    env = make_env("ant", "c", version="v4", use_contact_forces=True)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert other.options == env.options and other.engine.name == "c"
        jax.tree.map(np.testing.assert_array_equal, jax.jit(other.reset)(jax.random.PRNGKey(0)), state)
