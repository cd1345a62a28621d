"""SAC: its update equals Brax's, and what it has beyond it."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.training import acting
from brax.training.agents.sac import networks as brax_networks
from brax.training.agents.sac import train as brax_sac
from helpers import values
from peers import restore_device_put_replicated
from toy_tasks import BraxSizes, ToyTask

from mjx_walk.algos.off_policy_state import Batch
from mjx_walk.algos.sac import SAC, SACConfig
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.common.replay_buffer import ReplayBuffer
from mjx_walk.envs import make_env
from mjx_walk.utils.types import Transition

NUM_ENVS, BATCH, UPDATES = 16, 32, 5


CONFIG = SACConfig(
    unroll_length=1,
    grad_updates_per_step=UPDATES,
    batch_size=BATCH,
    replay_capacity=256,
    learning_starts=0,
    policy_learning_rate=1e-3,
    critic_learning_rate=1e-3,
    reward_scale=2.0,
    observation_clip=None,
    policy_hidden_layer_sizes=(32, 32),
    critic_hidden_layer_sizes=(32, 32),
)


def test_sac_update_equals_brax(monkeypatch):
    """Brax's own trainer, given our networks, our steps and our samples, ends at our parameters after five updates.

    Noise is a fixed function of the shape, since the two draw their keys in another order.
    """
    task = make_env("walker2d", physics="c")
    algorithm = SAC(task, NUM_ENVS, EvaluationConfig(1), CONFIG)
    state = jax.jit(algorithm.init)(jax.random.PRNGKey(0))
    collect, learn = jax.jit(algorithm.collect), jax.jit(algorithm.learn)
    for _ in range(4):
        state, _ = learn(*collect(state))
    state, (steps, stats) = collect(state)
    buffer = ReplayBuffer(task, NUM_ENVS, 16)
    drawn = buffer.sample(state.replay, jax.random.PRNGKey(7), UPDATES * BATCH, 1, CONFIG.discount)
    assert set(np.asarray(drawn.discount)) <= {0.0, np.float32(CONFIG.discount)}

    monkeypatch.setattr(ReplayBuffer, "sample", lambda *_: drawn)
    monkeypatch.setattr(jax.random, "normal", lambda key, shape: jnp.sin(jnp.arange(np.prod(shape)).reshape(shape)))
    # A new function: the one above is traced already, without the patches.
    ours, metrics = jax.jit(lambda *args: algorithm.learn(*args))(state, (steps, stats))
    metrics = values(metrics)
    assert int(ours.critic_updates - state.critic_updates) == UPDATES

    theirs = brax_after_its_updates(state, steps, drawn, monkeypatch)
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), ours.learner.critic, state.learner.critic)
    assert max(jax.tree.leaves(moved)) > 1e-3
    expected = (theirs.policy_params, theirs.q_params, theirs.target_q_params, theirs.alpha_params)
    learner = ours.learner
    result = (learner.policy, _as_brax(learner.critic), _as_brax(learner.target_critic), learner.log_alpha)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6), result, expected)
    np.testing.assert_allclose(ours.normalizer.mean, theirs.normalizer_params.mean, rtol=1e-5, atol=1e-6)
    assert metrics["alpha"] == pytest.approx(float(jnp.exp(theirs.alpha_params)), rel=1e-2)


def brax_after_its_updates(state, steps, drawn, monkeypatch):
    """Brax's training state after `UPDATES` updates on the drawn batch, from our parameters."""
    stored = drawn._replace(
        observation=steps.observation[0],
        action=steps.action[0],
        reward=steps.reward[0],
        discount=jnp.ones(NUM_ENVS),
        next_observation=steps.next_observation[0],
        extras={"state_extras": {"truncation": jnp.zeros(NUM_ENVS)}, "policy_extras": {}},
    )
    as_theirs = drawn._replace(discount=drawn.discount / CONFIG.discount, extras=drawn.extras | {"policy_extras": {}})
    found = {}
    begin = brax_sac._init_training_state
    monkeypatch.setattr(brax_sac, "_init_training_state", lambda **kwargs: with_our_parameters(begin(**kwargs), state))
    monkeypatch.setattr(acting, "actor_step", lambda env, env_state, *args, **kwargs: (env_state, stored))
    queue = brax_sac.replay_buffers.UniformSamplingQueue
    monkeypatch.setattr(queue, "sample", lambda self, buffer_state: (buffer_state, as_theirs))
    monkeypatch.setattr(brax_sac.pmap, "assert_is_replicated", lambda state: found.update(state=state))
    monkeypatch.setattr(acting.Evaluator, "run_evaluation", lambda *args, **kwargs: {})
    restore_device_put_replicated()
    brax_sac.train(
        environment=BraxSizes(),
        num_timesteps=NUM_ENVS,
        episode_length=1,
        num_envs=NUM_ENVS,
        num_eval_envs=1,
        learning_rate=1e-3,
        discounting=CONFIG.discount,
        batch_size=BATCH,
        normalize_observations=True,
        reward_scaling=CONFIG.reward_scale,
        tau=CONFIG.tau,
        max_replay_size=256,
        grad_updates_per_step=UPDATES,
        network_factory=lambda *args, **kwargs: brax_networks.make_sac_networks(
            *args, hidden_layer_sizes=(32, 32), **kwargs
        ),
    )
    return jax.tree.map(lambda x: x[0], found["state"])


def with_our_parameters(theirs, state):
    """Brax's first training state, with our parameters, statistics and optimizers' moments."""
    learner = state.learner
    replaced = {
        "policy_params": learner.policy,
        "q_params": _as_brax(learner.critic),
        "target_q_params": _as_brax(learner.target_critic),
        "alpha_params": learner.log_alpha,
        "normalizer_params": state.normalizer,
    }
    theirs = theirs.replace(**jax.tree.map(lambda x: x[None], replaced))
    critic_moments = learner.critic_optimizer._replace(
        mu=_as_brax(learner.critic_optimizer.mu), nu=_as_brax(learner.critic_optimizer.nu)
    )
    return theirs.replace(
        policy_optimizer_state=_adam(theirs.policy_optimizer_state, learner.policy_optimizer),
        q_optimizer_state=_adam(theirs.q_optimizer_state, critic_moments),
        alpha_optimizer_state=_adam(theirs.alpha_optimizer_state, learner.alpha_optimizer),
    )


def batch(remaining=1.0):
    """Transitions that are all zeros."""
    obs = jnp.zeros((64, 1))
    zero = obs[:, 0]
    data = Transition(obs, obs, zero, zero, obs, {"state_extras": {"truncation": zero}})
    return Batch(data, jnp.float32(1.0), 1.0, remaining)


def test_the_target_entropy_moves_over_the_schedule():
    """A new policy has less than 0.68 nats and more than -100, which is two thirds of the way at the half still."""
    algorithm = SAC(ToyTask(), 2, EvaluationConfig(1), SACConfig(target_entropy=-100.0, final_target_entropy=0.68))
    state = algorithm.init_learner(jax.random.PRNGKey(0))
    update = jax.jit(lambda left: algorithm.full_update(state, batch(left), jax.random.PRNGKey(0))[0].log_alpha)
    moved = [float(update(jnp.float32(left)) - state.log_alpha) for left in (1.0, 0.5, 0.0)]
    assert moved[0] < 0 and moved[1] < 0 < moved[2]


def test_sac_gradients_are_clipped():
    """Adam's first moments are a tenth of them."""
    for limit, is_clipped in ((1e-3, True), (None, False)):
        algorithm = SAC(ToyTask(), 2, EvaluationConfig(1), SACConfig(max_grad_norm=limit))
        state = algorithm.init_learner(jax.random.PRNGKey(0))
        data = batch()._replace(reward_scale=jnp.float32(1.0))
        data = data._replace(transitions=data.transitions._replace(reward=jnp.full(64, 100.0)))
        after, _ = jax.jit(algorithm.full_update)(state, data, jax.random.PRNGKey(0))
        moments = [optax.tree.get(after.critic_optimizer, "mu"), optax.tree.get(after.policy_optimizer, "mu")]
        norms = [float(optax.global_norm(part)) for part in moments]
        assert (max(norms) < 1.01e-4) is is_clipped and min(norms) > 0


def _as_brax(critics):
    """Our stacked critics as Brax's two modules; their first layer's last rows see padding."""
    inputs = 17 + 6
    layers = critics["params"]
    kernel = layers["hidden_0"]["kernel"]
    assert kernel.shape[1] == 24
    layers = layers | {"hidden_0": layers["hidden_0"] | {"kernel": kernel[:, :inputs]}}
    return {"params": {f"MLP_{i}": jax.tree.map(lambda x, i=i: x[i], layers) for i in range(2)}}


def _adam(theirs, ours):
    """Our Adam's state in the place of theirs, which also has the learning rate's, empty, state."""
    return (jax.tree.map(lambda x: x[None], ours), *theirs[1:])
