"""Every algorithm on tasks whose answer is known: values, then actions, then both."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_tasks
from brax.training.acme import running_statistics
from helpers import OPTIMIZED, slow_except

from mjx_walk.algos import ALGORITHMS
from mjx_walk.common import networks
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.training.programs import make_init, make_step

# A vmapped call cannot reuse its input's memory.
pytestmark = pytest.mark.filterwarnings("ignore:Some donated buffers")

DISCOUNT = 0.5
SMALL = {"policy_hidden_layer_sizes": (32, 32), "discount": DISCOUNT, "reward_scale": 1.0}
OFF_POLICY = SMALL | {
    "critic_hidden_layer_sizes": (32, 32),
    "batch_size": 64,
    "unroll_length": 1,
    "grad_updates_per_step": 4,
    "replay_capacity": 4096,
    "learning_starts": 128,
    "tau": 0.05,
    "policy_learning_rate": 1e-3,
    "critic_learning_rate": 3e-3,
}
DETERMINISTIC = OFF_POLICY | {"min_exploration_noise": 0.1, "max_exploration_noise": 0.8}
SETTINGS = {
    "ppo": SMALL
    | {
        "value_hidden_layer_sizes": (32, 32),
        "unroll_length": 4,
        "num_unrolls": 2,
        "num_minibatches": 4,
        "learning_rate": 3e-3,
        # With normalized advantages a noiseless task never stops to shrink the policy's std.
        "normalize_advantages": False,
        "entropy_coef": 1e-3,
    },
    "a2c": SMALL
    | {
        "value_hidden_layer_sizes": (32, 32),
        "unroll_length": 8,
        "learning_rate": 1e-2,
        "init_noise_std": 0.3,
        "normalize_advantages": False,
        "entropy_coef": 1e-3,
    },
    "reinforce": SMALL | {"unroll_length": 8, "learning_rate": 1e-2, "entropy_coef": 1e-2},
    "sac": OFF_POLICY | {"init_alpha": 1e-3, "alpha_learning_rate": 1e-6},
    "csac": OFF_POLICY
    | {"init_alpha": 1e-3, "alpha_learning_rate": 1e-6, "normalize_rewards": False, "normalized_return_max": 3.0},
    "td3": DETERMINISTIC,
    "ddpg": DETERMINISTIC,
}
UPDATES = {"ppo": 60, "a2c": 400, "reinforce": 400, "sac": 400, "csac": 400, "td3": 400, "ddpg": 400}


def values(name, task, config, state, obs):
    """What the algorithm believes the observations, `[N, 1]`, to be worth under its policy."""
    if name == "reinforce":
        return jnp.full(len(obs), jnp.nan)  # it has none
    if name in ("ppo", "a2c"):
        nets = networks.make_ppo_networks(task, config)
        return nets.value_network.apply(state.normalizer, state.params.value, obs)
    algorithm = ALGORITHMS[name][0](task, 8, EvaluationConfig(1), config)
    action = algorithm.policy(algorithm.policy_params(state))(obs, jax.random.PRNGKey(0))
    if name == "csac":
        critics = algorithm.nets.q_network
    else:
        critics = networks.make_deterministic_networks(task, config, 1 if name == "ddpg" else 2)[1]
    obs = running_statistics.normalize(obs, state.normalizer)
    return critics.apply(None, state.learner.critic, obs, action).min(axis=-1)


def train(name, task, **changes):
    """Value and action at a few observations after training, and whether the metrics are finite."""
    make, config_class = ALGORITHMS[name]
    config = config_class(**SETTINGS[name] | changes)
    algorithm = make(task, 32, EvaluationConfig(1), config)
    state = make_init(algorithm.init)(jax.random.PRNGKey(0))
    state, metrics = make_step(algorithm.collect, algorithm.learn, UPDATES[name], fused=True)(state)
    obs = jnp.float32([[-1.0], [0.0], [1.0]])
    action = algorithm.policy(algorithm.policy_params(state), deterministic=True)(obs, jax.random.PRNGKey(0))
    return values(name, task, config, state, obs), action[:, 0], jnp.isfinite(metrics["episodes"].value).all()


@functools.cache
def trained(name):
    """Value and action by the toy task. Compiled once, which is what takes long here."""
    indices = jnp.arange(len(toy_tasks.OneOf.TASKS))
    train_all = jax.vmap(lambda index: train(name, toy_tasks.OneOf(index)))
    found = jax.jit(train_all, compiler_options=OPTIMIZED)(indices)
    value, action, finite = jax.tree.map(np.asarray, found)
    assert finite.all()
    return dict(zip(toy_tasks.OneOf.TASKS, zip(value, action, strict=True), strict=True))


FAST = ("ppo", "sac")
algorithms = pytest.mark.parametrize("name", slow_except(FAST, SETTINGS))
with_values = pytest.mark.parametrize("name", slow_except(FAST, [name for name in SETTINGS if name != "reinforce"]))


@with_values
def test_constant_reward(name):
    assert trained(name)[toy_tasks.ConstantReward][0][1] == pytest.approx(1.0, abs=0.05)


@with_values
def test_reward_seen_in_the_observation(name):
    value = trained(name)[toy_tasks.ObservedReward][0]
    assert value[[0, 2]] == pytest.approx([-1.0, 1.0], abs=0.1)


@with_values
def test_discounting(name):
    value = trained(name)[toy_tasks.DelayedReward][0]
    assert value[[1, 2]] == pytest.approx([DISCOUNT, 1.0], abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["csac", "sac", "td3"])
def test_a_discount_that_changes(name):
    """The horizon grows from 2 steps to 8 during the first half of the training."""
    changes = {"final_discount": 0.875, "schedule_steps": 200 * 32}
    value, _, _ = jax.jit(lambda: train(name, toy_tasks.DelayedReward(), **changes), compiler_options=OPTIMIZED)()
    assert np.asarray(value)[[1, 2]] == pytest.approx([0.875, 1.0], abs=0.05)


@pytest.mark.slow
def test_an_entropy_that_changes():
    make, config_class = ALGORITHMS["sac"]
    changes = {"target_entropy": 0.3, "final_target_entropy": -1.0, "schedule_steps": 300 * 32}
    config = config_class(**OFF_POLICY | changes | {"init_alpha": 0.1, "alpha_learning_rate": 3e-3})
    task = toy_tasks.RewardedAction(10)
    algorithm = make(task, 32, EvaluationConfig(1), config)
    state, _ = make_step(algorithm.collect, algorithm.learn, 2100, fused=True)(
        make_init(algorithm.init)(jax.random.PRNGKey(0))
    )
    nets = networks.make_sac_networks(task, config)
    logits = nets.policy_network.apply(None, state.learner.policy, jnp.zeros((10_000, 1)))
    raw_action = nets.parametric_action_distribution.sample_no_postprocessing(logits, jax.random.PRNGKey(1))
    entropy = -nets.parametric_action_distribution.log_prob(logits, raw_action).mean()
    assert float(entropy) == pytest.approx(-1.0, abs=0.15)


@with_values
def test_a_time_limit_does_not_end_the_future(name):
    value = trained(name)[toy_tasks.EndlessReward][0]
    assert value[1] == pytest.approx(1.0 / (1.0 - DISCOUNT), abs=0.1)


@algorithms
def test_reward_for_an_action(name):
    assert trained(name)[toy_tasks.RewardedAction][1][1] == pytest.approx(0.5, abs=0.1)


@algorithms
def test_reward_for_an_action_that_suits_the_observation(name):
    value, action = trained(name)[toy_tasks.RewardedObservedAction]
    assert action[[0, 2]] == pytest.approx([-0.5, 0.5], abs=0.15)
    if name != "reinforce":
        assert value[[0, 2]] == pytest.approx([0.0, 0.0], abs=0.5 if name in ("ppo", "a2c") else 0.1)


def test_mountain_car_equals_gymnasiums():
    task = toy_tasks.MountainCar()
    env = gymnasium.make("MountainCarContinuous-v0")
    step = jax.jit(task.step)
    ends = 0
    for seed, push in ((0, 1.0), (1, 0.4), (2, 0.0)):
        obs, _ = env.reset(seed=seed)
        state = task._state(jnp.float32(obs[:1]), jnp.float32(obs[1:]), 0.0, False, jnp.int32(0))
        rng = np.random.default_rng(seed)
        for _ in range(999):
            action = np.float32([push * np.sign(obs[1] + 1e-9) + (1 - push) * rng.uniform(-1.5, 1.5)])
            state = step(state, action)
            obs, reward, terminated, truncated, _ = env.step(action)
            np.testing.assert_allclose(state.obs, obs, atol=2e-5)
            assert float(state.reward) == pytest.approx(reward, abs=1e-4)
            assert (bool(state.terminated), bool(state.truncated)) == (terminated, truncated)
            if terminated or truncated:
                ends += terminated
                break
            # Teacher-forced: rounding would otherwise add up over a thousand steps.
            state = state.replace(physics=state.physics._replace(qpos=jnp.float32(obs[:1]), qvel=jnp.float32(obs[1:])))
    assert ends >= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sac", "csac", "td3", "ddpg"])
def test_mountain_car_is_solved(name):
    """No reward until the top, which noise reaches only when each draw is kept for a while. Solved is 90."""
    changes = {
        "discount": 0.99,
        "reward_scale": 0.1,
        "unroll_length": 8,
        "grad_updates_per_step": 1,
        "policy_delay": 1,
        "batch_size": 256,
        "replay_capacity": 200_000,
        "learning_starts": 20_000,
        "noise_repeat": 20,
        "n_step": 10,
    }
    soft = {"init_alpha": 1.0, "alpha_learning_rate": 3e-4, "target_entropy": 0.0}
    own = {"sac": soft, "csac": soft | {"normalized_return_max": 10.0}}
    make, config_class = ALGORITHMS[name]
    config = config_class(**SETTINGS[name] | changes | own.get(name, {"max_exploration_noise": 1.0}))
    algorithm = make(toy_tasks.MountainCar(), 64, EvaluationConfig(8), config)
    step = make_step(algorithm.collect, algorithm.learn, 700, fused=True)
    train_once = jax.jit(lambda key: step(make_init(algorithm.init)(key)), compiler_options=OPTIMIZED)
    _, metrics = train_once(jax.random.PRNGKey(0))
    scores = metrics["eval_return"].value[metrics["eval_return"].has_value]
    assert scores[-1] > 90 > 10 > scores[0]
    assert metrics["replay_transitions"].value[-1] == 200_192
