"""The final and the best policy of a run, saved separately from its checkpoints and small enough to ship."""

import dataclasses
import functools
import logging
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.algos import Algorithm, make_algorithm
from mjx_walk.envs import TASKS, Task
from mjx_walk.envs.physics import resolve_engine
from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import Config, read_config
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.runs.scores import BEST, FINAL, POLICIES
from mjx_walk.utils.compat import standard_settings
from mjx_walk.utils.errors import UserError

__all__ = ["SavedPolicy", "deterministic_act", "make_acting_algorithm", "make_task"]

_LOGGER = logging.getLogger(__name__)


class SavedPolicy:
    """A policy of a run folder, and the task that it was trained on."""

    @standard_settings()
    def __init__(self, folder: RunFolder, physics: str | None = None, policy: str = BEST):
        """
        Args:
            folder: folder of a run that has saved a policy.
            physics: engine to use instead of the run's own.
            policy: `final`, the one of the newest checkpoint, or `best`, the one with the highest evaluation during
                training. Before the first evaluation ends, there is only `final`, and `best` gives that one.

        Raises:
            UserError: no usable policy.
        """
        self.path = folder.path
        saved = read_config(folder.config)
        self.reward_function = saved.env.reward_function
        """`PATH.py:FUNCTION` of the training, which is not loaded."""
        self.config = _without_reward_function(saved)
        self._physics = physics
        self._build()
        state = jax.eval_shape(self.algorithm.init, jax.random.PRNGKey(0))
        like = jax.eval_shape(self.algorithm.policy_params, state)
        self.policy_name = choose_policy(folder, policy)
        """`final` or `best`."""
        self.policy_params, self.policy_facts = load_policy(folder, self.policy_name, like)

    def _build(self) -> None:
        engine = self._physics or _engine_here(self.config.physics)
        self.task = make_task(dataclasses.replace(self.config, physics=engine))
        self.algorithm = make_acting_algorithm(self.task, self.config)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle and copy the parameters, without compiled functions."""
        kept = {name: value for name, value in vars(self).items() if name not in ("task", "algorithm", "act")}
        return kept | {"policy_params": jax.device_get(self.policy_params)}

    @standard_settings()
    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._build()

    @functools.cached_property
    def act(self) -> Callable:
        """The deterministic policy as a compiled JAX function of f32 observations."""
        return deterministic_act(self.algorithm, self.policy_params)

    def policy(self, obs: np.ndarray) -> np.ndarray:
        """The deterministic action for one observation or a batch, in Gymnasium's units.

        Args:
            obs: `[…, observation_size]`, any float dtype.
        """
        return np.asarray(self.act(np.asarray(obs, np.float32)))


def make_task(config: Config) -> Task:
    """Build the unbatched environment of a configuration."""
    return TASKS[config.env.name][0](config.env, config.physics)


def make_acting_algorithm(task: Task, config: Config) -> Algorithm:
    """The algorithm of a configuration, in float32: a policy then acts alike on every machine."""
    algo = dataclasses.replace(config.algo, network_dtype="float32")
    return make_algorithm(task, config.num_envs, config.evaluation, algo)


def deterministic_act(algorithm: Algorithm, policy_params: Any) -> Callable[[Any], Any]:
    """Compile the deterministic policy, `obs […, observation_size] → action […, action_size]`, in Gymnasium's units."""

    @jax.jit
    @standard_settings()
    def act(obs: jax.Array) -> jax.Array:
        policy = algorithm.policy(policy_params, deterministic=True)
        return policy(jnp.asarray(obs, jnp.float32), jax.random.PRNGKey(0))

    return act


def choose_policy(folder: RunFolder, name: str) -> str:
    """The name itself if the run has kept that policy; `final` in place of `best` if no evaluation has ended yet.

    Raises:
        UserError: an unknown name, or the run has not kept that policy.
    """
    if name not in POLICIES:
        raise UserError(f"policy={name}: choose one of: {', '.join(POLICIES)}")
    kept = [present for present in POLICIES if folder.policy(present).exists()]
    if not kept:
        raise UserError(f"{folder.path} holds no policy yet; train it first")
    if name in kept:
        return name
    if name == FINAL:
        raise UserError(f"{folder.path} has kept only its best policy; choose policy=best")
    _LOGGER.info("No evaluation during training has ended yet: this is the final policy.")
    return FINAL


def load_policy(folder: RunFolder, name: str, like: Any) -> tuple[Any, dict[str, Any]]:
    """A policy that a run has kept, its `env_steps`, and `eval_return` if an evaluation during training chose it.

    Raises:
        UserError: the policy is damaged, or it belongs to another environment.
    """
    try:
        params, meta = checkpoint.restore(folder.policy(name), like)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(str(error)) from error
    return params, {name: meta[name] for name in ("env_steps", "eval_return") if name in meta}


def _engine_here(name: str) -> str:
    """The engine that a run was trained on, or `auto` if this machine does not support it."""
    try:
        return resolve_engine(name)
    except UserError:
        return "auto"


def _without_reward_function(config: Config) -> Config:
    """Drop the reward function: a downloaded folder must not run code. The policy and its scores do not need it."""
    return dataclasses.replace(config, env=dataclasses.replace(config.env, reward_function=None))
