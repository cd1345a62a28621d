"""Training on Brax's environments: time limits, randomness, resumes, and one line for what is no such environment."""

import dataclasses
import functools
import logging
import math

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from brax.envs.fast import Fast, ObservationMode
from brax.envs.wrappers import training
from helpers import (
    OPTIMIZED,
    unregistered,
)
from mujoco import mjx

import mjx_walk
from mjx_walk.algos import ALGORITHMS
from mjx_walk.common import networks
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.common.rollout import evaluate
from mjx_walk.envs import TASKS, make_env
from mjx_walk.envs.vector_env import VectorEnv
from mjx_walk.training.programs import make_init, make_step
from mjx_walk.utils.errors import UserError


class Timed(Env):
    """Reward 1 a step. Half of the episodes, those that observe 1, terminate in the third step; others observe -1."""

    observation_size, action_size, backend = 2, 2, "none"

    def reset(self, rng):
        rng, kind_rng = jax.random.split(rng)
        kind = jax.random.rademacher(kind_rng, (), jnp.float32)
        zero = jnp.zeros(())
        return State(zero, jnp.stack([kind, 0.0]), zero, zero, {"reward_alive": zero, "x": zero}, {"rng": rng})

    def step(self, state, action):
        rng, noise_rng = jax.random.split(state.info["rng"])
        steps = state.pipeline_state + 1.0
        obs = state.obs.at[1].set(jax.random.normal(noise_rng))
        done = jnp.float32((state.obs[0] > 0) & (steps >= 3))
        one = jnp.ones(())
        metrics, info = {"reward_alive": one, "x": steps}, {**state.info, "rng": rng}
        return state.replace(pipeline_state=steps, obs=obs, reward=one, done=done, metrics=metrics, info=info)


class Wild(Fast):
    """An observation that is no number after two steps, or a state with another entry."""

    def __init__(self, grows=False):
        super().__init__()
        self._grows = grows

    def step(self, state, action):
        after = super().step(state, action)
        is_wild = after.pipeline_state.xd.vel[0] > 0.03
        info = {"more": jnp.zeros(())} if self._grows else {}
        return after.replace(obs=jnp.where(is_wild, jnp.nan, after.obs), info=info)


def make(env, **options):
    """The task of an environment, as a training makes it."""
    with unregistered():
        task = mjx_walk.from_brax(env, options.pop("episode_length", None))
        mjx_walk.register_task("own", task)
        kind, schema = TASKS["own"]
        return kind(schema(**options))


LIMITED = {
    "by the trainer": lambda: make(Timed(), episode_length=4),
    "by a setting": lambda: make(Timed(), max_episode_steps=4),
    "by Brax": lambda: make(training.EpisodeWrapper(Timed(), 4, 1)),
}
LONG = (pytest.mark.slow, pytest.mark.long)
limited = pytest.mark.parametrize("how", LIMITED)


@limited
def test_an_episode_terminates_or_reaches_its_time_limit(how):
    task = LIMITED[how]()
    env = VectorEnv(task, 32)
    state = env.init(jax.random.PRNGKey(0))
    terminates = np.asarray(state.env.obs[:, 0] > 0)
    others = jax.tree.map(lambda x: x[:0], state.env)
    step = jax.jit(env.step)
    for number in range(1, 5):
        before, noise = state.env, state.env.obs[:, 1]
        state, others, outcome, metrics = step(state, jnp.zeros((32, 2)), others, jnp.zeros((0, 2)))
        is_first = np.asarray(before.steps == number - 1)
        np.testing.assert_array_equal(outcome.terminated[is_first], terminates[is_first] & (number == 3))
        np.testing.assert_array_equal(outcome.truncated[is_first], np.full(is_first.sum(), number == 4))
        assert (outcome.obs[:, 1] != noise).all()  # the true next observation, not that of the reset
    assert terminates.any() and not terminates.all()
    assert metrics["reward_alive"].value == (~terminates).sum() * 4 and "x" not in metrics
    assert task.max_episode_steps == 4 and task.reward_terms == ("reward_alive",)


def test_brax_repeats_actions_within_its_time_limit():
    task = make(training.EpisodeWrapper(Timed(), 7, 2))
    _, lengths, _ = evaluate(task, 16, lambda obs, key: jnp.zeros((16, 2)), jax.random.PRNGKey(0))
    assert task.max_episode_steps == 4
    assert set(np.asarray(lengths)) == {2, 4}


@pytest.mark.parametrize("how", ["by Brax", *(pytest.param(how, marks=LONG) for how in LIMITED if how != "by Brax")])
def test_values_after_the_time_limit_count_and_after_a_termination_do_not(how):
    """With a discount of 0.5, an endless reward of 1 has the value 2, and that of at most three steps at most 1.75."""
    config_class = ALGORITHMS["ppo"][1]
    config = config_class(
        discount=0.5,
        reward_scale=1.0,
        unroll_length=4,
        num_unrolls=2,
        num_minibatches=4,
        learning_rate=3e-3,
        policy_hidden_layer_sizes=(32, 32),
        value_hidden_layer_sizes=(32, 32),
    )
    task = LIMITED[how]()
    algorithm = ALGORITHMS["ppo"][0](task, 32, EvaluationConfig(1), config)

    @functools.partial(jax.jit, compiler_options=OPTIMIZED)
    def train():
        state = make_init(algorithm.init)(jax.random.PRNGKey(0))
        state, _ = make_step(algorithm.collect, algorithm.learn, 60, fused=True)(state)
        nets = networks.make_ppo_networks(task, config)
        return nets.value_network.apply(state.normalizer, state.params.value, jnp.float32([[-1.0, 0.0], [1.0, 0.0]]))

    endless, ended = np.asarray(train())
    assert endless == pytest.approx(2.0, abs=0.1)
    assert 1.1 < ended < 1.75


def test_each_environment_has_its_own_random_numbers():
    task = make(Timed())

    @jax.jit
    def noise(seed):
        state = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(seed), 8))

        def step(state, _):
            state = jax.vmap(task.step)(state, jnp.zeros((8, 2)))
            return state, state.obs[:, 1]

        return jax.lax.scan(step, state, length=5)[1]

    first, again, other = noise(0), noise(0), noise(1)
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(np.concatenate([first, other]))) == 2 * 5 * 8


def test_our_own_tasks_are_the_same_through_brax_interface():
    task, own = (
        make(mjx_walk.BraxEnv("inverted_pendulum", "c"), max_episode_steps=3),
        make_env("inverted_pendulum", "c"),
    )
    state, expected = task.reset(jax.random.PRNGKey(3)), own.reset(jax.random.PRNGKey(3))
    step, own_step = jax.jit(task.step), jax.jit(own.step)
    for number, action in enumerate(jnp.float32([[0.3], [1.0], [-1.0]])):
        np.testing.assert_array_equal(state.obs, expected.obs)
        state, expected = step(state, action), own_step(expected, 3.0 * action)
        assert state.reward == expected.reward == state.metrics["reward_survive"] == 1.0
        assert state.truncated == (number == 2) and not state.terminated


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Brax System")
def test_a_real_environment_is_brax_own():
    env = brax.envs.get_environment("inverted_pendulum", backend="positional")
    task = make(env, episode_length=6)
    reset, step, own_step = jax.jit(task.reset), jax.jit(task.step), jax.jit(env.step)
    state, own = reset(jax.random.PRNGKey(3)), jax.jit(env.reset)(jax.random.PRNGKey(3))
    assert (task.observation_size, task.action_size, task.action_low, task.action_high) == (4, 1, -1.0, 1.0)
    for number, action in enumerate(jnp.float32([[0.3], [1.0], [-1.0], [0.7], [1.0], [1.0]])):
        np.testing.assert_allclose(state.obs, own.obs, rtol=1e-6, atol=1e-7)
        state, own = step(state, action), own_step(own, action)
        assert state.reward == own.reward and state.terminated == (own.done > 0)
        assert state.truncated == (number == 5)
        assert state.reward.dtype == state.obs.dtype == jnp.float32 and state.terminated.dtype == bool


def test_policies_see_state_of_several_observations(caplog):
    with caplog.at_level(logging.INFO, "mjx_walk"):
        task = make(Fast(asymmetric_obs=True, obs_mode=ObservationMode.DICT_STATE))
    assert "Of the observations privileged_state, state, policy and critic see 'state'" in caplog.text
    state = task.step(task.reset(jax.random.PRNGKey(0)), jnp.ones(1))
    np.testing.assert_allclose(state.obs, [0.0004, 0.02], rtol=1e-6)


def test_an_episode_ends_before_an_observation_that_is_not_finite():
    task = make(Wild())
    first = task.step(task.reset(jax.random.PRNGKey(0)), jnp.ones(1))
    second = task.step(first, jnp.ones(1))
    assert not first.terminated and second.terminated
    assert second.metrics["nonfinite"] == 1.0 and second.reward == 0.0
    np.testing.assert_array_equal(second.obs, first.obs)
    jax.tree.map(np.testing.assert_array_equal, second.memory, first.memory)


def test_a_state_that_changes_its_structure_is_refused():
    task = make(Wild(grows=True))
    with pytest.raises(UserError, match=r"own changes its state: .info\['more'\] is missing after a reset and float32"):
        task.step(task.reset(jax.random.PRNGKey(0)), jnp.ones(1))


def test_states_of_warp_are_refused():
    pytest.importorskip("warp")
    data = mjx.make_data(make_env("inverted_pendulum", "c").model, impl="warp", naconmax=4, njmax=4)
    env = Fast()
    env.reset = lambda rng: Fast().reset(rng).replace(pipeline_state=data)
    with pytest.raises(UserError, match="the environment simulates on MJX-Warp"):
        mjx_walk.from_brax(env)


@dataclasses.dataclass
class Bare:
    """Something without Brax's interface."""

    name: str = "bare"


@pytest.mark.parametrize(
    ("make_env", "keywords", "message"),
    [
        (lambda: training.wrap(Fast()), {}, "in a AutoResetWrapper, but the trainer itself batches and resets"),
        (lambda: training.VmapWrapper(Fast()), {}, "in a VmapWrapper, but"),
        (lambda: training.EpisodeWrapper(Fast(), 9, 1), {"episode_length": 5}, "episode_length=5: the EpisodeWrapper"),
        *((Fast, {"episode_length": n}, f"a time limit of {n} steps: give an integer from 1") for n in (0, 2.5, True)),
        (lambda: Fast, {}, "Fast has not the reset, step and action_size of a Brax environment"),
        (Bare, {}, "Bare has not the reset, step"),
        (lambda: Fast(obs_mode=ObservationMode.DICT_PIXELS), {}, "none is 'state', which the policy would see"),
    ],
)
def test_other_objects_are_refused(make_env, keywords, message):
    with pytest.raises(UserError, match="(?s)" + message) as error:
        mjx_walk.from_brax(make_env(), **keywords)
    assert "\n" not in str(error.value)


def test_steps_last_as_long_as_those_of_the_environment():
    clocked = type("Clocked", (Timed,), {"dt": 0.02})
    assert make(clocked()).dt == 0.02 and make(Timed()).dt == math.inf
    assert make(training.EpisodeWrapper(clocked(), 8, 4)).dt == 0.08
