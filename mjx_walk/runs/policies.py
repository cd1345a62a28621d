"""The best policy of a run, saved separately from its checkpoints and small enough to ship."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from mjx_walk.algos import Algorithm, make_algorithm
from mjx_walk.envs import TASKS, Task
from mjx_walk.envs.physics import resolve_engine
from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import Config, read_config
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.utils.errors import UserError

__all__ = ["SavedPolicy", "deterministic_act", "make_task"]


class SavedPolicy:
    """The best policy of a run folder, and the task that it was trained on."""

    def __init__(self, folder: RunFolder, physics: str | None = None):
        """
        Args:
            folder: folder of a run that has saved a policy.
            physics: engine to use instead of the run's own.

        Raises:
            UserError: no usable policy.
        """
        self.path = folder.path
        saved = read_config(folder.config)
        self.reward_function = saved.env.reward_function
        """`PATH.py:FUNCTION` of the training, which is not loaded."""
        self.config = _without_reward_function(saved)
        engine = physics or _engine_here(self.config.physics)
        self.task = make_task(dataclasses.replace(self.config, physics=engine))
        # Acting in float32 gives the same actions on every machine.
        algo = dataclasses.replace(self.config.algo, network_dtype="float32")
        self.algorithm = make_algorithm(self.task, self.config.num_envs, self.config.evaluation, algo)
        state = jax.eval_shape(self.algorithm.init, jax.random.PRNGKey(0))
        like = jax.eval_shape(self.algorithm.policy_params, state)
        self.policy_params, self.policy_facts = load_best_policy(folder, like)

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


def deterministic_act(algorithm: Algorithm, policy_params: Any) -> Callable[[Any], Any]:
    """Compile the deterministic policy, `obs […, observation_size] → action […, action_size]`, in Gymnasium's units."""
    policy = algorithm.policy(policy_params, deterministic=True)
    return jax.jit(lambda obs: policy(obs, jax.random.PRNGKey(0)))


def load_best_policy(folder: RunFolder, like: Any) -> tuple[Any, dict[str, Any]]:
    """The best policy of a run and its facts; see `checkpoint.restore`.

    Raises:
        UserError: the run has saved none yet, it is damaged, or it belongs to another environment.
    """
    if not folder.best_policy.exists():
        raise UserError(f"{folder.path} holds no policy yet; train it first")
    try:
        return checkpoint.restore(folder.best_policy, like)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(str(error)) from error


def _engine_here(name: str) -> str:
    """The engine that a run was trained on, or `auto` if this machine does not support it."""
    try:
        return resolve_engine(name)
    except UserError:
        return "auto"


def _without_reward_function(config: Config) -> Config:
    """Drop the reward function: a downloaded folder must not run code. The policy and its scores do not need it."""
    return dataclasses.replace(config, env=dataclasses.replace(config.env, reward_function=None))
