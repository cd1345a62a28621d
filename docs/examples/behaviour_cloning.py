"""Behaviour cloning of a dataset of Minari: python behaviour_cloning.py DATASET_ID [NUM_UPDATES [NUM_EPISODES]].

A network learns the actions by regression, without rewards, and then plays in Gymnasium. It needs no mjx_walk.
"""

import functools
import sys

import gymnasium
import jax
import jax.numpy as jnp
import minari
import numpy as np
import optax

HIDDEN_LAYERS, BATCH_SIZE, LEARNING_RATE = (256, 256), 256, 1e-3


def init(key, sizes):
    keys = jax.random.split(key, len(sizes) - 1)
    shapes = zip(keys, sizes[:-1], sizes[1:], strict=True)
    return [(jax.random.normal(key, (n, m)) / n**0.5, jnp.zeros(m)) for key, n, m in shapes]


def act(params, obs):
    *hidden, (weights, biases) = params
    for w, b in hidden:
        obs = jax.nn.swish(obs @ w + b)
    return jnp.tanh(obs @ weights + biases)  # relative to the range of actions


@functools.partial(jax.jit, static_argnames="num_updates")
def learn(params, obs, actions, key, num_updates):
    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, num_updates))

    def update(carry, key):
        params, state = carry
        rows = jax.random.randint(key, (BATCH_SIZE,), 0, len(obs))
        loss, grads = jax.value_and_grad(lambda p: jnp.mean((act(p, obs[rows]) - actions[rows]) ** 2))(params)
        updates, state = optimizer.update(grads, state)
        return (optax.apply_updates(params, updates), state), loss

    (params, _), losses = jax.lax.scan(update, (params, optimizer.init(params)), jax.random.split(key, num_updates))
    return params, losses


def play(spec, policy, num_episodes):
    envs = gymnasium.make_vec(spec, num_envs=num_episodes, vectorization_mode="sync")
    obs, _ = envs.reset(seed=0)
    returns, is_over = np.zeros(num_episodes), np.zeros(num_episodes, bool)
    while not is_over.all():
        obs, rewards, terminated, truncated, _ = envs.step(np.asarray(policy(obs)))
        returns += rewards * ~is_over
        is_over |= terminated | truncated
    return returns


def main(dataset_id, num_updates=80_000, num_episodes=100):
    dataset = minari.load_dataset(dataset_id)
    episodes = list(dataset.iterate_episodes())
    obs = np.concatenate([episode.observations[:-1] for episode in episodes])
    actions = np.concatenate([episode.actions for episode in episodes])
    mean, std, high = obs.mean(axis=0), obs.std(axis=0) + 1e-6, dataset.action_space.high
    params = init(jax.random.key(0), (obs.shape[1], *HIDDEN_LAYERS, actions.shape[1]))
    clone, losses = learn(
        params, jnp.float32((obs - mean) / std), jnp.float32(actions / high), jax.random.key(1), num_updates
    )
    print(f"loss: {losses[0]:.2g} at the start, {losses[-100:].mean():.2g} at the end")
    policy = jax.jit(lambda params, obs: high * act(params, (obs - mean) / std))
    scores = {
        "dataset": np.array([episode.rewards.sum() for episode in episodes]),
        "untrained": play(dataset.env_spec, functools.partial(policy, params), num_episodes),
        "clone": play(dataset.env_spec, functools.partial(policy, clone), num_episodes),
    }
    for who, returns in scores.items():
        print(f"{who}: {returns.mean():.1f} ± {returns.std(ddof=1):.1f}, lowest {returns.min():.1f}")


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
