"""A Brax environment as a task that the trainers take. MuJoCo Playground's environments have the same interface."""

import logging
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.wrappers.training import EpisodeWrapper
from jax import Array
from jaxtyping import Float, PRNGKeyArray
from mujoco import mjx

from mjx_walk.interop.external_task import ExternalTask, Moment, make_task_class
from mjx_walk.machine.compat import prepare_jax, standard_dtypes
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PyTree

__all__ = ["from_brax"]

_LOGGER = logging.getLogger(__name__)
_EPISODE_LENGTH = 1000
"""Brax's default."""
_FOR_BATCHES = re.compile("AutoReset|Vmap|Eval")
"""Part of the names of Brax's and Playground's wrappers that batch, reset or evaluate environments."""
_OBSERVATION = "state"
"""The policy's observations, if there are several. Source: `policy_obs_key` of Brax's networks."""


def from_brax(env: Any, episode_length: int | None = None, name: str | None = None) -> type[ExternalTask]:
    """A class with which `run(task=…)` and `load_run(task=…)` train and load on a Brax environment.

    Actions are in [-1, 1]. Of several observations, policy and critic see `state`. `done` terminates the episode,
    unless `info["truncation"]` of Brax's `EpisodeWrapper` says that its time limit did. Metrics whose names begin with
    `reward` are logged as reward terms. The environment's random numbers follow from the key of its reset. Episodes
    that share a start (metric `resets/reuse_rate`) also share these numbers.

    Args:
        env: a `brax.envs.Env`, or an object with its `reset`, `step` and `action_size`, as MuJoCo Playground's
            environments. It is one environment, which does not reset itself.
        episode_length: time limit in steps, by default 1000, as in Brax. An environment in an `EpisodeWrapper` has
            its own. `env.max_episode_steps=N` replaces the default; of two limits the shorter one counts.
        name: of the class, such as `CartpoleBalance`, which is registered as `cartpole_balance`. Default: `Brax` and
            the name of the environment's class.

    Raises:
        UserError: an environment of another library, one that batches or resets itself, two time limits, or
            observations that are not arrays.
    """
    prepare_jax()
    if isinstance(env, type) or not all(hasattr(env, member) for member in ("reset", "step", "action_size")):
        kind = env.__name__ if isinstance(env, type) else type(env).__name__
        raise UserError(
            f"{kind} has not the reset, step and action_size of a Brax environment; give one such as "
            "brax.envs.get_environment('ant'), and mjx_walk.from_gymnax one of gymnax"
        )
    layers = list(_layers(env))
    for layer in layers:
        if any(_FOR_BATCHES.search(kind.__name__) for kind in type(layer).__mro__):
            raise UserError(
                f"the environment is in a {type(layer).__name__}, but the trainer itself batches and resets; give "
                "from_brax the environment without this wrapper, such as env.unwrapped"
            )
    limits = [math.ceil(one.episode_length / one.action_repeat) for one in layers if isinstance(one, EpisodeWrapper)]
    if limits and episode_length is not None:
        raise UserError(f"episode_length={episode_length}: the EpisodeWrapper has a time limit; give one of them")
    if episode_length is None:
        episode_length = min(limits, default=_EPISODE_LENGTH)
    kind = type(layers[-1]).__name__
    return make_task_class(_BraxEnvironment(env), name or f"Brax{kind[0].upper()}{kind[1:]}", episode_length)


def _layers(env: Any) -> Iterator[Any]:
    """The environment's wrappers from the outermost one, and the environment itself."""
    while env is not None:
        yield env
        env = vars(env).get("env")


class _BraxEnvironment:
    """One unbatched environment with Brax's interface."""

    library = "brax"

    def __init__(self, env: Any):
        self._env = env
        ones = jnp.ones(env.action_size, jnp.float32)
        self.action_low, self.action_high = -ones, ones
        repeats = math.prod(one.action_repeat for one in _layers(env) if isinstance(one, EpisodeWrapper))
        self.dt = float(getattr(env, "dt", math.inf)) * repeats
        with standard_dtypes():
            start = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), jnp.uint32))
        _refuse_warp(start)
        self._key = _observation_key(start.obs)
        if jnp.ndim(start.reward):
            raise UserError(f"the environment is a batch of {start.reward.shape[0]}; give from_brax a single one")

    def reset(self, key: PRNGKeyArray) -> Moment:
        return self._moment(self._env.reset(key))

    def step(self, inner: PyTree, action: Float[Array, " action_size"]) -> Moment:
        return self._moment(self._env.step(inner, action))

    def _moment(self, state: Any) -> Moment:
        truncated = jnp.asarray(state.info.get("truncation", 0.0)) > 0
        return Moment(
            inner=state,
            obs=state.obs if self._key is None else state.obs[self._key],
            reward=state.reward,
            terminated=(jnp.asarray(state.done) > 0) & ~truncated,
            truncated=truncated,
            terms={_term(name): value for name, value in state.metrics.items() if name.startswith("reward")},
        )


def _refuse_warp(state: PyTree) -> None:
    """Refuse a state of MJX-Warp. Its contacts are in one array for all environments, so none can be reset alone.

    Raises:
        UserError: it is one.
    """
    nodes = jax.tree.leaves(state, is_leaf=lambda node: isinstance(node, mjx.Data))
    if any(isinstance(node, mjx.Data) and node.impl == mjx.Impl.WARP for node in nodes):
        raise UserError(
            "the environment simulates on MJX-Warp, where from_brax cannot reset one environment alone; load it with "
            "MJX's other implementation, in Playground registry.load(NAME, config_overrides={'impl': 'jax'})"
        )


def _term(name: str) -> str:
    """Playground's `reward/upright` as `reward_upright`."""
    return name.replace("/", "_")


def _observation_key(obs: Array | Mapping[str, Array]) -> str | None:
    """The entry of several observations that the policy sees; None for a single one.

    Raises:
        UserError: there is no such entry.
    """
    if not isinstance(obs, Mapping):
        return None
    if _OBSERVATION not in obs:
        raise UserError(f"of the observations {', '.join(obs)}, none is '{_OBSERVATION}', which the policy would see")
    _LOGGER.info("Of the observations %s, policy and critic see '%s'", ", ".join(obs), _OBSERVATION)
    return _OBSERVATION
