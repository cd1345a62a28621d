"""Compare an environment of this package with Gymnasium's own, in everything that both return."""

import gymnasium
import numpy as np

import mjx_walk  # noqa: F401  registers the names
from mjx_walk.machine.quiet_mujoco import hide_deprecations

REGISTERED = [name for name in gymnasium.registry if name.startswith("mjx_walk/")]
IDS = [name.removeprefix("mjx_walk/") for name in REGISTERED if name != "mjx_walk/Pusher-v4"]
TIMES = ("t", "episode_time")
"""Entries that hold wall-clock times."""


def make_both(name, make=gymnasium.make, ours=None, theirs=None, **keywords):
    """An environment of this package on the `c` engine, and Gymnasium's own, with the same keywords and their own."""
    with hide_deprecations():
        return make(f"mjx_walk/{name}", physics="c", **keywords | (ours or {})), make(name, **keywords | (theirs or {}))


def assert_same(ours, real, atol=2e-3, path=""):
    """Equal keys, shapes, types and dtypes, and values that differ by the rounding of the state to float32."""
    if isinstance(real, dict):
        assert isinstance(ours, dict) and ours.keys() == real.keys(), (path, ours, real)
        for key in real:
            if key not in TIMES:
                assert_same(ours[key], real[key], atol, f"{path}.{key}")
    elif isinstance(real, (list, tuple)) or getattr(getattr(real, "dtype", None), "kind", None) == "O":
        assert type(ours) is type(real) and len(ours) == len(real), path
        for i, pair in enumerate(zip(ours, real, strict=True)):
            assert_same(*pair, atol, f"{path}[{i}]")
    elif isinstance(real, (str, type(None), gymnasium.Space)):
        assert ours == real, path
    else:
        _assert_same_numbers(ours, real, atol, path)


def _assert_same_numbers(ours, real, atol, path):
    assert type(ours) is type(real) or np.isscalar(real), (path, type(ours), type(real))
    ours, real = np.asarray(ours), np.asarray(real)
    # Of float32 actions, Gymnasium computes some reward terms in float32.
    is_term = ".reward_" in path or not real.ndim
    same_dtype = ours.dtype.kind == real.dtype.kind or real.dtype.kind == "i" if is_term else ours.dtype == real.dtype
    assert ours.shape == real.shape and same_dtype, (path, ours.dtype, real.dtype, ours.shape, real.shape)
    if real.dtype == np.uint8:  # frames: ours show the last position, up to one physics step later
        assert np.mean(ours != real) < 0.06, path
    else:
        np.testing.assert_allclose(ours, real, rtol=1e-3, atol=atol, err_msg=path)


def played(env, num_steps, seed=3):
    """What an environment returns from a seed on, and the type of an exception that ends it."""
    found = [env.observation_space, env.action_space, env.render_mode]
    found.append(env.reset(seed=seed))
    space = getattr(env, "single_action_space", env.action_space)
    env.action_space.seed(seed)
    for _ in range(num_steps):
        action = env.action_space.sample()
        found.append(env.step(np.float64(action) if isinstance(space, gymnasium.spaces.Box) else action))
    return found


def outcome(wrap, env, num_steps=12):
    """`played` for a wrapped environment, or the type of the exception that it raises."""
    try:
        return played(wrap(env), num_steps)
    except Exception as error:
        return type(error).__name__
    finally:
        env.close()


def make_and_reset() -> gymnasium.Env:
    """A walker that is reset where it is made. Spawned processes import it from here, but not from a test."""
    env = gymnasium.make("mjx_walk:mjx_walk/Walker2d-v5", physics="c")
    env.reset()
    return env
