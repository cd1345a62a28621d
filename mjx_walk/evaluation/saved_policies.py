"""The policies that a run keeps by name, saved separately from its checkpoints and small enough to ship."""

import dataclasses
import functools
import logging
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.algos import Algorithm, TrainState, make_algorithm, without_replay
from mjx_walk.common.inline_evaluation import NO_RETURN
from mjx_walk.envs import TASKS, BaseTask
from mjx_walk.envs.pickling import ReadFiles, files_of, warn_of_changed_files
from mjx_walk.envs.randomization.options import Randomization
from mjx_walk.machine.compat import standard_settings
from mjx_walk.settings.config import Config, training_command
from mjx_walk.settings.input_files import check_model, warn_of_changed_inputs
from mjx_walk.settings.saved_config import as_yaml, config_of, read_saved_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, FINAL, MILESTONES, POLICIES
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Act, PolicyFn, PolicyParams

__all__ = [
    "SavedPolicy",
    "best_policy",
    "choose_policy",
    "default_policy",
    "deterministic_act",
    "deterministic_policy",
    "in_float32",
    "kept_policies",
    "load_policy",
    "make_task",
]

_LOGGER = logging.getLogger(__name__)


class SavedPolicy:
    """A policy of a run folder, and the task that it was trained on."""

    _NOT_PICKLED: tuple[str, ...] = ("task", "algorithm", "act")
    """Attributes that hold compiled functions or threads, and are built again."""

    @standard_settings()
    def __init__(self, folder: RunFolder, physics: str | None = None, policy: str = BEST):
        """
        Args:
            folder: folder of a run that has saved a policy.
            physics: engine to use instead of the run's own.
            policy: `final`, the one of the newest checkpoint, or `best`, the one with the highest evaluation during
                training or at its end. Before the first evaluation ends, there is only `final`, and `best` gives it.
                `medium` and `simple` exist after a training with `checkpoint.milestones`.

        Raises:
            UserError: no usable policy.
        """
        self.path = folder.path.absolute()
        """The folder, whatever becomes of the working directory."""
        saved = read_saved_config(folder)
        self.reward_function = saved.env.reward_function
        """`PATH.py:FUNCTION` of the training, which is not loaded."""
        self.config = _as_scored(saved)
        self._physics = physics
        check_model(folder, self.config.env)
        self._build()
        warn_of_changed_inputs(folder, saved.env)
        self.policy_name = choose_policy(folder, policy)
        """`final`, `best`, `medium` or `simple`."""
        self.policy_params, self.policy_metadata = _load(folder, self.policy_name, self.algorithm)

    def _build(self) -> None:
        config, engine = self.config, self._physics or _engine_here(self.config)
        self.task = make_task(dataclasses.replace(config, physics=engine))
        self.algorithm = in_float32(make_algorithm(self.task, config.num_envs, config.evaluation, config.algo))

    def __getstate__(self) -> dict[str, object]:
        """Pickle and copy the parameters and the configuration as a text, without compiled functions.

        The classes of the settings of a registered task or algorithm exist in this process only.
        """
        kept = {name: value for name, value in vars(self).items() if name not in self._NOT_PICKLED}
        changed = {"config": as_yaml(self.config), "policy_params": jax.device_get(self.policy_params)}
        return kept | changed | {"_read_files": files_of(self.task)}

    @standard_settings()
    def __setstate__(self, state: dict[str, Any]) -> None:
        read_files: ReadFiles = state.pop("_read_files")
        config = config_of(state.pop("config"), RunFolder(state["path"]).config)
        vars(self).update(state, config=config)
        self._build()
        warn_of_changed_files(read_files)

    @functools.cached_property
    def command(self) -> str:
        """The command that trained the policy. It names files and another run without the user's folders."""
        saved = read_saved_config(RunFolder(self.path))
        own, source = saved.env.reward_function, saved.init_from
        env = dataclasses.replace(saved.env, reward_function=own and Path(own).name)
        return training_command(dataclasses.replace(saved, env=env, init_from=source and Path(source).name))

    @functools.cached_property
    def act(self) -> Act:
        """The deterministic policy as a compiled JAX function of f32 observations."""
        return deterministic_act(self.algorithm, self.policy_params)

    def policy(self, obs: np.ndarray) -> np.ndarray:
        """The deterministic action for one observation or a batch, in Gymnasium's units.

        Args:
            obs: `[…, observation_size]`, any float dtype.

        Raises:
            UserError: the observation has another size, or is no array.
        """
        size = self.task.observation_size
        try:
            obs = np.asarray(obs, np.float32)
        except (TypeError, ValueError) as error:
            also = "; env.reset() returns the observation and info" if isinstance(obs, tuple) else ""
            raise UserError(f"the observation is no array of numbers; this policy takes […, {size}]{also}") from error
        if obs.shape[-1:] != (size,):
            raise UserError(f"the observation has the shape {obs.shape}; this policy takes […, {size}]")
        return np.asarray(self.act(obs))


def make_task(config: Config) -> BaseTask:
    """Build the unbatched environment of a configuration."""
    return TASKS[config.env.name][0](config.env, config.physics)


def in_float32(algorithm: Algorithm) -> Algorithm:
    """The algorithm with networks in float32, whose policies act alike on every machine."""
    if algorithm.config.network_dtype == "float32":
        return algorithm
    return dataclasses.replace(algorithm, config=dataclasses.replace(algorithm.config, network_dtype="float32"))


def deterministic_act(algorithm: Algorithm, policy_params: PolicyParams) -> Act:
    """Compile the deterministic policy, `obs […, observation_size] → action […, action_size]`, in Gymnasium's units."""

    @jax.jit
    @standard_settings()
    def act(obs: jax.Array) -> jax.Array:
        policy = deterministic_policy(algorithm, policy_params)
        return policy(jnp.asarray(obs, jnp.float32), jax.random.PRNGKey(0))

    return act


def deterministic_policy(algorithm: Algorithm, policy_params: PolicyParams) -> PolicyFn:
    """The deterministic policy, `(obs, key) → action`.

    It multiplies matrices in float32. A GPU's default precision would change actions by up to 4e-3.
    """
    return functools.partial(_in_float32, algorithm.policy(policy_params, deterministic=True))


def _in_float32(policy: PolicyFn, obs: jax.Array, key: jax.Array) -> jax.Array:
    with jax.default_matmul_precision("float32"):
        return policy(obs, key)


def choose_policy(folder: RunFolder, name: str) -> str:
    """The name itself if the run has kept that policy; `final` in place of `best` if no evaluation has ended yet.

    Raises:
        UserError: an unknown name, or the run has not kept that policy.
    """
    if name not in POLICIES:
        raise UserError(f"policy={name}: choose one of: {', '.join(POLICIES)}")
    kept = kept_policies(folder)
    if name in kept:
        return name
    if name in MILESTONES:
        raise UserError(
            f"{folder.path} has no {name} policy; a complete training with checkpoint.milestones=true keeps one"
        )
    if name == FINAL and kept and not checkpoint.list_steps(folder.checkpoints):
        raise UserError(f"{folder.path} has kept only its best policy; choose policy=best")
    if FINAL in kept:
        _LOGGER.info("No evaluation during training has ended yet: this is the final policy.")
        return FINAL
    if not checkpoint.list_steps(folder.checkpoints):
        raise UserError(f"{folder.path} holds no policy yet; train it first")
    return name


def default_policy(folder: RunFolder) -> str:
    """`final`, or `best` for a folder that has kept only that one, as those of the zoo."""
    return BEST if kept_policies(folder) == [BEST] else FINAL


def kept_policies(folder: RunFolder) -> list[str]:
    """Names of the policies that a run has kept, `final` first."""
    return [name for name in POLICIES if checkpoint.find(folder.policy(name))]


def _load(folder: RunFolder, name: str, algorithm: Algorithm) -> tuple[PolicyParams, Metadata]:
    """A policy that a run has kept. If the final or the best one is damaged, the newest complete checkpoint has it."""
    state = algorithm.state_shapes()
    try:
        return load_policy(folder, name, jax.eval_shape(algorithm.policy_params, state))
    except UserError as error:
        if name in MILESTONES:
            raise
        try:
            state, metadata = checkpoint.restore_newest(folder.checkpoints, without_replay(state))
        except UserError:
            raise error from None
        warnings.warn(f"{error}; the policy of the checkpoint at step {metadata['env_steps']:,} is used", stacklevel=2)
    num_devices = metadata.get("num_devices", 1)
    best = best_policy(state, algorithm.steps_per_iteration * num_devices) if name == BEST else None
    return best or (algorithm.policy_params(state), {"env_steps": metadata["env_steps"]})


def load_policy(folder: RunFolder, name: str, like: PolicyParams) -> tuple[PolicyParams, Metadata]:
    """A policy that a run has kept, its `env_steps`, and `eval_return` if an evaluation during training chose it.

    The metadata of a milestone also have its `fraction`.

    Raises:
        UserError: the policy is missing or damaged, or it belongs to another environment.
    """
    path = checkpoint.find(folder.policy(name))
    if path is None:
        raise UserError(f"{folder.policy(name)} is missing")
    try:
        params, meta = checkpoint.restore(path, like)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(str(error)) from error
    metadata: Metadata = {"env_steps": meta["env_steps"]}
    if "eval_return" in meta:
        metadata["eval_return"] = meta["eval_return"]
    if "fraction" in meta:
        metadata["fraction"] = meta["fraction"]
    return params, metadata


def best_policy(state: TrainState, steps_per_iteration: int) -> tuple[PolicyParams, Metadata] | None:
    """Policy with the highest inline evaluation, and its metadata. None until the first evaluation ends.

    Args:
        state: a TrainState.
        steps_per_iteration: environment steps of an iteration, over all devices.
    """
    evaluation = state.evaluation
    if evaluation.best_return <= NO_RETURN:  # -inf in older runs
        return None
    env_steps = int(evaluation.best_iteration) * steps_per_iteration
    return evaluation.best_policy_params, {"env_steps": env_steps, "eval_return": float(evaluation.best_return)}


def _engine_here(config: Config) -> str:
    """The engine that a run was trained on, or `auto` if this machine does not support it."""
    try:
        return TASKS[config.env.name][0].resolve_physics(config.physics)
    except UserError:
        return "auto"


def _as_scored(config: Config) -> Config:
    """Drop what a policy and its scores do not need: randomized physics, and the reward function.

    A downloaded folder must not run code.
    """
    env = dataclasses.replace(config.env, reward_function=None, randomize=Randomization())
    return dataclasses.replace(config, env=env)
