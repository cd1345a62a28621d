"""The categorical critic's parts, against slow NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_tasks

from mjx_walk.algos.csac import CSAC, CSACConfig, project
from mjx_walk.algos.off_policy_state import Batch
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Transition

CONFIG = CSACConfig(
    policy_hidden_layer_sizes=(16,), critic_hidden_layer_sizes=(16,), num_atoms=21, normalized_return_max=2.0
)


def project_slowly(probs, positions, atoms):
    """Algorithm 1 of Bellemare et al. 2017."""
    target = np.zeros((len(probs), len(atoms)))
    spacing = atoms[1] - atoms[0]
    for row, (masses, places) in enumerate(zip(probs, positions, strict=True)):
        for mass, place in zip(masses, np.clip(places, atoms[0], atoms[-1]), strict=True):
            index = min(max((place - atoms[0]) / spacing, 0.0), len(atoms) - 1.0)
            below, above = int(np.floor(index)), int(np.ceil(index))
            if below == above:
                target[row, below] += mass
            else:
                target[row, below] += mass * (above - index)
                target[row, above] += mass * (index - below)
    return target


def test_projection_equals_the_published_algorithm():
    rng = np.random.default_rng(0)
    atoms = np.linspace(-2.0, 2.0, 21)
    probs = rng.dirichlet(np.ones(21), size=50)
    positions = rng.normal(scale=1.5, size=(50, 1)) + rng.uniform(0, 1, size=(50, 1)) * atoms
    found = np.asarray(project(jnp.float32(probs), jnp.float32(positions), jnp.float32(atoms)))
    np.testing.assert_allclose(found, project_slowly(probs, positions, atoms), atol=2e-6)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-5)
    inside = np.abs(positions).max(axis=1) < 2.0
    assert 5 < inside.sum() < 45
    np.testing.assert_allclose(found[inside] @ atoms, (probs * positions).sum(axis=1)[inside], atol=1e-5)


def test_critic_loss_is_the_cross_entropy_to_the_lower_critics_future():
    """One update's loss, computed once more from the networks alone."""

    task = toy_tasks.ObservedReward(10)
    algorithm = CSAC(task, 4, EvaluationConfig(1), CONFIG)
    state = algorithm.init_learner(jax.random.PRNGKey(0))
    state = state.replace(target_critic=jax.tree.map(lambda x: 3.0 * x + 0.1, state.critic))
    keys = jax.random.split(jax.random.PRNGKey(1), 5)
    obs, next_obs = jax.random.normal(keys[0], (2, 64, task.observation_size))
    action = jax.random.uniform(keys[1], (64, task.action_size), minval=-1.0)
    reward = jax.random.normal(keys[2], (64,))
    discount = 0.9 * jax.random.bernoulli(keys[3], 0.7, (64,)).astype(jnp.float32)
    data = Transition(obs, action, reward, discount, next_obs)
    _, metrics = algorithm.critic_update(state, Batch(data, jnp.float32(0.5), 1.0, 1.0), keys[4])

    nets, log_distributions, atoms = algorithm.nets, algorithm.log_probs, algorithm.atoms
    distribution = nets.parametric_action_distribution
    logits = nets.policy_network.apply(None, state.policy, next_obs)
    raw = distribution.sample_no_postprocessing(logits, keys[4])
    entropy_bonus = -jnp.exp(state.log_alpha) * distribution.log_prob(logits, raw)
    both = np.exp(log_distributions(state.target_critic, next_obs, distribution.postprocess(raw)))
    means = both @ np.asarray(atoms)
    assert 0 < (means[:, 0] < means[:, 1]).sum() < 64
    lower = np.where((means[:, 0] < means[:, 1])[:, None], both[:, 0], both[:, 1])
    future = np.asarray(atoms)[None] + np.asarray(entropy_bonus)[:, None]
    positions = 0.5 * np.asarray(reward)[:, None] + np.asarray(discount)[:, None] * future
    target = project_slowly(lower, positions, np.asarray(atoms))
    logs = np.asarray(log_distributions(state.critic, obs, action))
    expected = -(target[:, None] * logs).sum(axis=-1).mean(axis=0).sum()
    assert float(metrics["critic_loss"]) == pytest.approx(expected, rel=1e-4)
    for name, mass in (("lowest", target[:, 0]), ("highest", target[:, -1])):
        assert 0 < mass.mean() == pytest.approx(float(metrics[f"target_mass_{name}_atom"]), rel=1e-4)


def test_returns_need_a_bound():
    with pytest.raises(UserError, match="normalized_return_max=null: csac needs"):
        CSAC(toy_tasks.ObservedReward(10), 4, EvaluationConfig(1), CSACConfig(normalized_return_max=None))
