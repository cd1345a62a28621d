"""What every algorithm's state has in common."""

import jax
import numpy as np
import pytest
from helpers import small_settings
from toy_tasks import EndlessReward

from mjx_walk.algos import ALGORITHMS, is_finite, learned_leaves, make_algorithm
from mjx_walk.common.inline_evaluation import EvaluationConfig

PARTS = {
    **dict.fromkeys(("ppo", "a2c"), ("params.policy", "params.value", "optimizer", "learning_rate")),
    "reinforce": ("params.policy", "optimizer", "learning_rate"),
    **dict.fromkeys(
        ("sac", "csac"), ("learner.policy", "learner.critic", "learner.target_critic", "learner.log_alpha")
    ),
    **dict.fromkeys(
        ("td3", "ddpg"), ("learner.policy", "learner.critic", "learner.target_policy", "learner.policy_opt")
    ),
}


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
    for part in (*PARTS[algo], "normalizer.mean", "return_scale.variance"):
        assert any(name.startswith(part) for name in leaves), part
    assert not any(name.startswith(("env.", "evaluation.", "replay.", "exploration")) for name in leaves)
    check = jax.jit(is_finite)
    assert check(state)
    for i, (name, leaf) in enumerate(leaves.items()):
        leaf.flat[-1] = np.inf if i % 2 else np.nan
        assert not check(state), name
        leaf.flat[-1] = 0
    assert check(state)
