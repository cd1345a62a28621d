"""What every algorithm's state has in common."""

import jax
import numpy as np
import pytest
from helpers import OFF_POLICY, small_settings
from toy_tasks import EndlessReward

from mjx_walk.algos import ALGORITHMS, is_finite, learned_leaves, make_algorithm
from mjx_walk.algos.a2c import A2CConfig
from mjx_walk.algos.deterministic import DeterministicConfig
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.algos.ppo import PPOConfig
from mjx_walk.algos.sac import SACConfig
from mjx_walk.common.inline_evaluation import EvaluationConfig

PARTS = {
    OnPolicyConfig: ("params.policy", "optimizer", "learning_rate"),
    A2CConfig: ("params.value",),
    PPOConfig: ("params.value",),
    OffPolicyConfig: ("learner.policy", "learner.critic"),
    SACConfig: ("learner.target_critic", "learner.log_alpha"),
    DeterministicConfig: ("learner.target_policy", "learner.policy_opt"),
}
"""Leaves that an algorithm learns, by the classes from which its settings derive."""


def state_of_zeros(algo):
    """The state of an algorithm with small networks, without running or compiling its `init`."""
    config = ALGORITHMS[algo][1](**small_settings(algo))
    algorithm = make_algorithm(EndlessReward(), 4, EvaluationConfig(num_envs=2), config)
    shapes = jax.eval_shape(algorithm.init, jax.random.PRNGKey(0))
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_one_value_that_is_not_finite_in_any_learned_leaf_is_noticed(algo):
    state = state_of_zeros(algo)
    leaves = learned_leaves(state)
    parts = [part for kind, parts in PARTS.items() if issubclass(ALGORITHMS[algo][1], kind) for part in parts]
    for part in (*parts, "normalizer.mean", "return_scale.variance"):
        assert any(name.startswith(part) for name in leaves), part
    assert not any(name.startswith(("env.", "evaluation.", "replay.", "exploration")) for name in leaves)
    check = jax.jit(is_finite)
    assert check(state)
    for i, (name, leaf) in enumerate(leaves.items()):
        leaf.flat[-1] = np.inf if i % 2 else np.nan
        assert not check(state), name
        leaf.flat[-1] = 0
    assert check(state)


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("is_random", [True, False])
def test_only_replays_get_random_step_counts_after_falls(algo, is_random):
    config = ALGORITHMS[algo][1](**small_settings(algo, init_at_random_episode_step=is_random))
    algorithm = make_algorithm(EndlessReward(), 4, EvaluationConfig(num_envs=2), config)
    assert algorithm.env.init_at_random_episode_step == is_random
    assert algorithm.env.random_step_after_falls == (is_random and algo in OFF_POLICY)
