"""Networks: what they compute in, and what they hand on."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.networks import ACTIVATION

from mjx_walk.algos.a2c import A2CConfig
from mjx_walk.algos.ppo import PPOConfig
from mjx_walk.algos.sac import SACConfig
from mjx_walk.common import networks
from mjx_walk.envs import make_env
from mjx_walk.settings.config import load_config

KEY = jax.random.PRNGKey(0)


def actor_and_critic(config):
    """Functions of parameters, observation and action; and parameters."""
    task = make_env("walker2d", physics="c")
    normalizer = networks.init_normalizer(task.observation_size)
    if isinstance(config, SACConfig):
        nets = networks.make_sac_networks(task, config)
        policy, critic = nets.policy_network, nets.q_network
        value = lambda params, obs, action: critic.apply(None, params, obs, action)  # noqa: E731
    else:
        nets = networks.make_ppo_networks(task, config)
        policy, critic = nets.policy_network, nets.value_network
        value = lambda params, obs, action: critic.apply(normalizer, params, obs)  # noqa: E731
    return lambda params, obs: policy.apply(normalizer, params, obs), value, policy.init(KEY), critic.init(KEY)


@pytest.mark.parametrize("name", ["humanoid", "walker2d"])
def test_their_precision_does_not_reach_the_physics(name):
    """As the products are written down for the compiler, with what training sets for the networks' ones."""
    task = make_env(name, physics="jax")
    state = jax.eval_shape(task.reset, KEY)
    act, _, params, _ = actor_and_critic(PPOConfig())

    def precisions(function, *arguments):
        text = str(jax.make_jaxpr(function)(*arguments))
        found = re.findall(r"precision=\(Precision\.(\w+), Precision\.(\w+)\)", text)
        assert len(found) == text.count("= dot_general[") > 0
        return {precision for pair in found for precision in pair}

    with jax.default_matmul_precision(load_config([f"env={name}"]).matmul_precision):
        assert precisions(task.step, state, jnp.zeros(task.action_size)) == {"HIGHEST"}
        assert precisions(act, params, jnp.zeros(17)) == {"HIGH"}  # which is TF32


@pytest.mark.parametrize("make_config", [PPOConfig, A2CConfig, SACConfig])
def test_networks_compute_in_bfloat16(make_config):
    """About as in float32, but not the same; parameters, results and gradients stay float32."""
    obs, action = jax.random.normal(KEY, (64, 17)), jnp.tanh(jax.random.normal(KEY, (64, 6)))
    results = []
    for dtype in ("float32", "bfloat16"):
        act, value, policy_params, critic_params = actor_and_critic(make_config(network_dtype=dtype))
        grads = jax.grad(lambda params, value=value: jnp.square(value(params, obs, action)).sum())(critic_params)
        results.append(jax.tree.leaves((act(policy_params, obs), value(critic_params, obs, action), grads)))
    for exact, rough in zip(*results, strict=True):
        assert exact.dtype == rough.dtype == jnp.float32
        assert np.linalg.norm(rough - exact) < 0.1 * np.linalg.norm(exact)
        assert not np.array_equal(rough, exact) or exact.std() == 0.0


def test_critics_are_brax_networks_of_their_own():
    """Padding changes nothing: zeros in, no gradient; and the two differ."""
    _, value, _, params = actor_and_critic(SACConfig())
    obs, action = jax.random.normal(KEY, (64, 17)), jnp.zeros((64, 6))
    kernel = params["params"]["hidden_0"]["kernel"]
    grad = jax.grad(lambda params: value(params, obs, action).sum())(params)["params"]["hidden_0"]["kernel"]
    assert kernel.shape == (2, 24, 256) and (kernel[:, 23] == 0).all() and (grad[:, 23] == 0).all()
    values = np.asarray(value(params, obs, action))
    assert values.shape == (64, 2) and not np.allclose(values[:, 0], values[:, 1])


def test_running_statistics_are_of_all_that_was_seen():
    obs = jax.random.normal(KEY, (3, 50, 2)) * 2.0 + jnp.arange(3.0)[:, None, None]
    normalizer = networks.init_normalizer(2)
    for part in obs:
        normalizer = networks.update_normalizer(normalizer, part)
    np.testing.assert_allclose(normalizer.mean, obs.mean((0, 1)), rtol=1e-4)
    np.testing.assert_allclose(normalizer.std, obs.std((0, 1)), rtol=1e-3)


def test_observations_are_clipped_on_policy():
    far, bound = jnp.full((1, 17), 100.0), jnp.full((1, 17), 2.0)
    for clip, is_same in ((2.0, True), (None, False)):
        act, value, policy_params, critic_params = actor_and_critic(PPOConfig(observation_clip=clip))
        assert bool((act(policy_params, far) == act(policy_params, bound)).all()) is is_same
        assert bool((value(critic_params, far, None) == value(critic_params, bound, None)).all()) is is_same


def keeps_shapes(activation):
    """Whether a function maps an array to one of its shape, and has a gradient."""
    inputs = jax.ShapeDtypeStruct((2, 4), jnp.float32)
    try:
        grad = jax.eval_shape(jax.grad(lambda x: activation(x).sum()), inputs)
        return jax.eval_shape(activation, inputs).shape == grad.shape == (2, 4)
    except (TypeError, AttributeError, IndexError):
        return False


def test_the_activations_are_those_functions_that_keep_shapes():
    assert {name for name, function in ACTIVATION.items() if keeps_shapes(function)} == {*networks.ACTIVATIONS}
    assert {"relu", "swish", "tanh"} < {*networks.ACTIVATIONS} < ACTIVATION.keys()
