"""What the off-policy loop passes to its learner, reported by one that learns nothing."""

import dataclasses

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import values
from toy_tasks import EndlessReward, ToyTask

from mjx_walk.algos.off_policy import OffPolicyAlgorithm
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.common.inline_evaluation import EvaluationConfig

NUM_ENVS = 4


class FarAway(ToyTask):
    """Observations of -1000 and 1000 by turns."""

    def start(self, key):
        return jnp.full(1, -1000.0), jnp.zeros(1)

    def move(self, qpos, qvel, action):
        return -qpos, qvel, 1.0, False


class Learner(flax.struct.PyTreeNode):
    policy: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Reporter(OffPolicyAlgorithm):
    """Learns nothing, and reports what it is handed; its policy is a hundredth of the observation."""

    def init_learner(self, key):
        return Learner(jnp.zeros(1))

    def act(self, params, obs, key, deterministic):
        return 0.01 * obs

    def explore(self, params, obs, key):
        return 0.01 * obs

    def critic_update(self, learner, batch, key):
        largest = jnp.abs(batch.transitions.observation).max()
        rate = jnp.float32(batch.rate_factor)
        return learner, {"rate": rate, "largest_observation": largest, "scale": batch.reward_scale}

    full_update = critic_update


def iterate(task, num_iterations, **changes):
    """Algorithm, state and the metrics of all iterations of `Reporter`."""
    settings = {
        "unroll_length": 2,
        "grad_updates_per_step": 1,
        "batch_size": 64,
        "replay_capacity": 64,
        "learning_starts": 0,
    }
    config = OffPolicyConfig(**settings | changes)
    algorithm = Reporter(task, NUM_ENVS, EvaluationConfig(1), config)
    state, rows = algorithm.init(jax.random.PRNGKey(0)), []
    iteration = jax.jit(lambda state: algorithm.learn(*algorithm.collect(state)))
    for _ in range(num_iterations):
        state, metrics = iteration(state)
        rows.append(values(metrics))
    return algorithm, state, {name: np.stack([row[name] for row in rows]) for name in metrics}


@pytest.mark.parametrize(("schedule", "rates"), [("linear", [1.0, 0.75, 0.5, 0.25, 0.0]), ("constant", [1.0] * 5)])
def test_learning_rates_follow_their_schedule(schedule, rates):
    settings = {"learning_rate_schedule": schedule, "schedule_steps": 4 * 2 * NUM_ENVS}
    _, _, metrics = iterate(EndlessReward(), 5, **settings)
    np.testing.assert_allclose(metrics["rate"], rates)


def test_normalized_rewards_keep_the_largest_return_within_its_bound():
    """A reward of 1 at each step for 10 steps: the largest discounted return is more than the std of all."""
    _, state, metrics = iterate(
        EndlessReward(10), 12, normalize_rewards=True, normalized_return_max=0.5, reward_scale=2.0
    )
    largest = float(state.return_scale.largest)
    assert largest == pytest.approx(sum(0.99**i for i in range(10)), rel=1e-5)
    assert metrics["scale"][-1] == pytest.approx(2.0 * 0.5 / largest, rel=1e-5)
    _, state, metrics = iterate(EndlessReward(10), 12, reward_scale=2.0)
    np.testing.assert_array_equal(metrics["scale"], 2.0)


def test_actions_are_random_until_the_replay_is_filled():
    """The policy acts 0 on this task."""
    _, state, _ = iterate(EndlessReward(), 3, learning_starts=2 * 2 * NUM_ENVS)
    actions = np.asarray(state.replay.action[:6])
    assert (actions[:4] != 0.0).all() and len(np.unique(actions[:4])) == 4 * NUM_ENVS
    np.testing.assert_array_equal(actions[4:], 0.0)


@pytest.mark.parametrize(("clip", "seen"), [(0.5, 0.5), (None, 1000.0)])
def test_observations_are_clipped_where_the_policy_acts_and_where_it_learns(clip, seen):
    algorithm, state, metrics = iterate(FarAway(), 2, observation_clip=clip, normalize_observations=False)
    assert metrics["largest_observation"][-1] == seen
    assert float(jnp.abs(state.replay.action[:4]).max()) == pytest.approx(0.01 * seen)
    acted = algorithm.policy(algorithm.policy_params(state))(jnp.full((1, 1), 60.0), jax.random.PRNGKey(0))
    assert float(acted[0, 0]) == pytest.approx(0.01 * min(seen, 60.0))


class SlowSteps(EndlessReward):
    dt = 0.016


@pytest.mark.parametrize(("task", "noise", "targets"), [(SlowSteps(), 4, 2), (EndlessReward(), 6, 4)])
def test_noise_and_targets_last_as_long_at_every_control_frequency(task, noise, targets):
    """64 ms and 40 ms, at 16 and at 10 ms a step. Before learning starts, only the noise's key decides on actions."""
    algorithm, state, _ = iterate(task, 6, n_step=None, noise_repeat=None, learning_starts=64)
    actions = np.asarray(state.replay.action)[:12, 0, 0]
    assert algorithm.n_step == targets
    np.testing.assert_array_equal(actions, actions[np.arange(12) // noise * noise])
    assert len(np.unique(actions)) == 12 // noise


def test_a_long_step_is_one_step():
    algorithm, _, _ = iterate(type("Slowest", (EndlessReward,), {"dt": 0.2})(), 1, n_step=None, noise_repeat=None)
    assert (algorithm.n_step, algorithm.noise_repeat) == (1, 1)
