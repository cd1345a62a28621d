"""A gymnax environment as a task that the trainers take."""

import dataclasses
import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.envs import NO_TIME_LIMIT
from mjx_walk.interop.external_task import ExternalTask, Moment, make_task_class
from mjx_walk.machine.compat import prepare_jax
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PyTree

__all__ = ["from_gymnax"]

_LIMIT = "max_steps_in_episode"


def from_gymnax(env: Any, params: Any = None, name: str | None = None) -> type[ExternalTask]:
    """A class with which `run(task=…)` and `load_run(task=…)` train and load on a gymnax environment.

    Actions are in the environment's units. The time limit is `params.max_steps_in_episode`, or
    `env.max_episode_steps=N`. It truncates an episode; the environment's own end terminates it. The keys of the steps
    follow from the key of the reset. Episodes that share a start (metric `resets/reuse_rate`) share them.

    Args:
        env: with gymnax's `reset_env` and `step_env`, not in a wrapper. It is one environment. gymnax 0.0.8 to 1.0.1
            work.
        params: its parameters. Default: `env.default_params`.
        name: of the class, such as `Pendulum`, which is registered as `pendulum`. Default: `Gymnax` and the
            environment's name.

    Raises:
        UserError: an environment of another library or in a wrapper, or actions that are discrete or have no bounds.
    """
    prepare_jax()
    kind = type(env)
    if not all(hasattr(kind, member) for member in ("reset_env", "step_env", "action_space")):
        raise UserError(
            f"{kind.__name__} has no reset_env and step_env of its own; give an environment of gymnax.make without "
            "wrappers, and mjx_walk.from_brax one of Brax"
        )
    params = env.default_params if params is None else params
    limit = getattr(params, _LIMIT, None)
    if limit is None:
        raise UserError(f"the parameters of {env.name} have no {_LIMIT}; add it, as the time limit in steps")
    words = re.findall("[A-Za-z0-9]+", re.sub(r"-v\d+$", "", env.name))
    class_name = "".join(f"{word[0].upper()}{word[1:]}" for word in ("gymnax", *words))
    return make_task_class(_GymnaxEnvironment(env, params), name or class_name, int(limit))


class _GymnaxEnvironment:
    """One gymnax environment without a time limit. Its state has the key of the next step."""

    library = "gymnax"

    def __init__(self, env: Any, params: Any):
        space = env.action_space(params)
        if not (hasattr(space, "low") and hasattr(space, "high")):
            raise UserError(
                f"{env.name} has discrete actions; the trainers need continuous ones, such as those of Pendulum-v1, "
                "MountainCarContinuous-v0 and Reacher-misc"
            )
        low, high = (np.broadcast_to(bound, space.shape).ravel() for bound in (space.low, space.high))
        if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
            raise UserError(f"the actions of {env.name} have no bounds: {low} to {high}; bound its action_space")
        self.action_low, self.action_high = jnp.float32(low), jnp.float32(high)
        self._env = env
        self._params = dataclasses.replace(params, **{_LIMIT: NO_TIME_LIMIT})
        self._action_shape = space.shape
        self.dt = float(getattr(params, "dt", math.inf))

    def reset(self, key: PRNGKeyArray) -> Moment:
        key, reset_key = jax.random.split(key)
        obs, state = self._env.reset_env(reset_key, self._params)
        no = jnp.zeros((), bool)
        return Moment((key, state), obs, jnp.zeros(()), no, no, {})

    def step(self, inner: tuple[PRNGKeyArray, PyTree], action: Float[Array, " action_size"]) -> Moment:
        key, step_key = jax.random.split(inner[0])
        action = jnp.reshape(action, self._action_shape)
        obs, state, reward, done, _ = self._env.step_env(step_key, inner[1], action, self._params)
        return Moment((key, state), obs, reward, jnp.asarray(done, bool), jnp.zeros((), bool), {})
