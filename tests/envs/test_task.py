"""Purity, vmap, and the guard against broken physics."""

from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_walk.envs import TASKS, make_env
from mjx_walk.envs.physics import base
from mjx_walk.utils.errors import UserError


def test_vmap_equals_one_by_one():
    task = make_env("walker2d", physics="c")
    states = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(0), 20))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (20, 6), minval=-1, maxval=1)
    together = jax.vmap(task.step)(states, actions)
    for i in (0, 7, 19):
        alone = task.step(jax.tree.map(lambda x, i=i: x[i], states), actions[i])
        jax.tree.map(np.testing.assert_array_equal, alone, jax.tree.map(lambda x, i=i: x[i], together))


def test_nested_vmap_calls_the_engine_once():
    sizes = []

    def batch(x):
        sizes.append(x.shape)
        return 2 * x

    doubled = jax.vmap(jax.vmap(base.batch_once(batch)))(jnp.ones((3, 4, 5)))
    assert doubled.shape == (3, 4, 5) and sizes[-1] == (12, 5)


@pytest.mark.parametrize("name", TASKS)
def test_broken_physics_ends_the_episode_and_reaches_nobody(name):
    task = make_env(name, physics="c")
    good = task.reset(jax.random.PRNGKey(0))
    broken = good.replace(physics=good.physics._replace(qvel=good.physics.qvel.at[0].set(jnp.nan)))
    after = task.step(broken, jnp.zeros(task.action_size))
    assert bool(after.terminated) and after.metrics["nonfinite"] == 1
    np.testing.assert_array_equal(after.obs, good.obs)
    assert after.reward == 0 and all(np.isfinite(value) for value in after.metrics.values())
    sound = task.step(good, jnp.zeros(task.action_size))
    assert sound.metrics["nonfinite"] == 0 and not bool(sound.terminated)


def test_velocities_beyond_mujocos_limit_are_broken():
    """Of 1e10, where MuJoCo itself begins an episode anew."""
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


def test_an_action_that_is_not_a_number_is_caught():
    task = make_env("humanoid", physics="c")
    state = task.reset(jax.random.PRNGKey(0))
    after = task.step(state, jnp.full(17, jnp.nan))
    assert after.metrics["nonfinite"] == 1 and np.isfinite(after.obs).all() and np.isfinite(after.reward)


def test_state_is_lean():
    task = make_env("humanoid", physics="c")
    state = task.reset(jax.random.PRNGKey(0))
    assert sum(x.size for x in jax.tree.leaves(state)) < task.observation_size + 100


@pytest.mark.parametrize(
    ("kwargs", "says"),
    [
        ({"name": "ant"}, "unknown env 'ant'; choose one of: humanoid, humanoid_standup, walker2d"),
        ({"version": "v3"}, "choose one of: v5, v4"),
        ({"physics": "bullet"}, "choose one of: auto, warp, jax, c"),
        ({"healthy_rewad": 1.0}, "did you mean 'healthy_reward'?"),
        ({"xml_file": "no_such.xml"}, "model file not found"),
        ({"frame_skip": 0}, "must be at least 1"),
        ({"name": "humanoid", "version": "v4", "include_cvel_in_observation": False}, "does not take include_cvel"),
    ],
)
def test_mistakes_are_named(kwargs, says):
    with pytest.raises(UserError, match=says.replace("?", r"\?")):
        make_env(**({"name": "walker2d", "physics": "c"} | kwargs))


def test_own_model_file(tmp_path):
    source = Path(gymnasium.__path__[0]) / "envs" / "mujoco" / "assets" / "walker2d_v5.xml"
    text = source.read_text().replace('timestep="0.002"', 'timestep="0.001"')
    own = tmp_path / "own.xml"
    own.write_text(text)
    task = make_env("walker2d", physics="c", xml_file=str(own))
    assert task.dt == pytest.approx(0.004)
    assert task.gymnasium_kwargs() == {"xml_file": str(own)}
