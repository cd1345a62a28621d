"""The replay buffer and n-step targets, against a plain Python list of every step ever taken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_tasks
from helpers import slow_except

from mjx_walk.common.replay_buffer import ReplayBuffer, Steps
from mjx_walk.common.returns import n_step_return


def test_n_step_return_by_hand():
    reward = jnp.float32([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [4.0, 4.0, 4.0]])
    ended = jnp.array([[False, True, False], [False, False, True], [False, False, False]])
    total, length = n_step_return(reward, ended, 0.5)
    np.testing.assert_allclose(total, [1 + 1 + 1, 1, 1 + 1])
    assert length.tolist() == [3, 1, 2]


class Counter(toy_tasks.ToyTask):
    """The observation identifies the environment, the episode and the step; one in eight actions ends the episode."""

    observation_size = 3

    def __init__(self, max_episode_steps):
        super().__init__(max_episode_steps)


def play(num_envs, num_steps, limit, seed=0):
    """Random episodes: `[num_steps, num_envs, …]`, with true next observations."""
    rng = np.random.default_rng(seed)
    episode, step = np.zeros(num_envs), rng.integers(0, limit, num_envs)
    rows = []
    for _ in range(num_steps):
        obs = np.stack([np.arange(num_envs), episode, step], axis=1)
        step = step + 1
        terminated, truncated = rng.random(num_envs) < 0.12, step >= limit
        next_obs = np.stack([np.arange(num_envs), episode, step], axis=1)
        rows.append(
            (obs, rng.uniform(-1, 1, (num_envs, 1)), rng.normal(size=num_envs), terminated, truncated, next_obs)
        )
        done = terminated | truncated
        episode, step = episode + done, np.where(done, 0, step)
    return [np.stack(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize("limit", slow_except([7], [3, 7, 50]))
@pytest.mark.parametrize("n_step", [1, 3])
def test_samples_are_true_transitions_at_any_fill(limit, n_step):
    """Every field of every sample, next observations across episode ends included, while the buffer goes round."""
    num_envs, rows, unroll, discount = 4, 12, 2, 0.9
    obs, action, reward, terminated, truncated, next_obs = play(num_envs, 60, limit)
    buffer = ReplayBuffer(Counter(limit), num_envs, rows)
    insert = jax.jit(buffer.insert, donate_argnums=0)
    sample = jax.jit(lambda replay, key: buffer.sample(replay, key, 1024, n_step, discount))
    replay = buffer.init()
    at = {tuple(obs[t, b]): (t, b) for t in range(60) for b in range(num_envs)}
    num_truncated = 0
    for start in range(0, 60, unroll):
        part = slice(start, start + unroll)
        fields = (obs, action, reward, terminated, truncated, next_obs)
        steps = [jnp.asarray(x[part], bool if x.dtype == bool else jnp.float32) for x in fields]
        replay = insert(replay, Steps(*steps))
        written = start + unroll
        if written <= n_step:
            continue
        drawn = jax.tree.map(np.asarray, sample(replay, jax.random.PRNGKey(start)))
        begins = {at[tuple(row)] for row in drawn.observation}
        oldest = max(0, written - rows)
        assert begins == {(t, b) for t in range(oldest, written - n_step) for b in range(num_envs)}
        for i, row in enumerate(drawn.observation):
            t, b = at[tuple(row)]
            total, last = 0.0, t
            for k in range(n_step):
                last = t + k
                total += discount**k * reward[last, b]
                if terminated[last, b] or truncated[last, b]:
                    break
            assert drawn.reward[i] == pytest.approx(total, abs=1e-5)
            np.testing.assert_allclose(drawn.action[i], action[t, b], rtol=1e-6)
            if terminated[last, b]:
                assert drawn.discount[i] == 0.0
            else:
                assert drawn.discount[i] == pytest.approx(discount ** (last - t + 1))
                assert tuple(drawn.next_observation[i]) == tuple(next_obs[last, b])
                num_truncated += truncated[last, b]
    assert num_truncated > (0 if limit < 50 else -1)


def test_memory_is_counted_and_types_are_kept():
    task = Counter(100)
    buffer = ReplayBuffer(task, 8, 1000, "bfloat16")
    replay = buffer.init()
    assert replay.observation.dtype == jnp.bfloat16 and replay.end.dtype == jnp.int16
    assert buffer.num_transitions == 8000 and buffer.num_slots == 10
    assert buffer.num_bytes == sum(x.nbytes for x in jax.tree.leaves(replay))
    # One observation a transition, not two: 3 × 2 bytes, action and reward 4 each, end 2.
    assert buffer.num_bytes == pytest.approx(8000 * (6 + 4 + 4 + 2), rel=0.02)


def test_a_last_observation_is_found_in_any_of_very_many_slots():
    buffer = ReplayBuffer(Counter(10), 1, 500_000)
    replay = buffer.init().replace(cuts=jnp.array([40_000]))
    one = jnp.ones((1, 1))
    is_cut = jnp.ones((1, 1), bool)
    obs = jnp.full((1, 1, 3), 7.0)
    replay = buffer.insert(replay, Steps(0 * obs, one[..., None], one, ~is_cut, is_cut, obs))
    replay = buffer.insert(replay, Steps(0 * obs, one[..., None], one, ~is_cut, ~is_cut, 0 * obs))
    drawn = buffer.sample(replay, jax.random.PRNGKey(0), 8, 1, 0.9)
    assert (drawn.next_observation == 7).all() and (drawn.discount == np.float32(0.9)).all()


def test_insertion_writes_in_place():
    """The compiled insertion of a few rows allocates nothing of the buffer's size, and touches few bytes."""
    task = Counter(1000)
    buffer = ReplayBuffer(task, 64, 4096)
    steps = Steps(
        jnp.zeros((2, 64, 3)),
        jnp.zeros((2, 64, 1)),
        jnp.zeros((2, 64)),
        *jnp.zeros((2, 2, 64), bool),
        jnp.zeros((2, 64, 3)),
    )
    compiled = jax.jit(buffer.insert, donate_argnums=0).lower(buffer.init(), steps).compile()
    memory = compiled.memory_analysis()
    assert memory.alias_size_in_bytes >= buffer.num_bytes * 0.99
    assert memory.temp_size_in_bytes < buffer.num_bytes / 50
