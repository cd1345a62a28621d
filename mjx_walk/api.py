"""The Python API, which the commands use as well: train a run, load a run."""

import contextlib
import dataclasses
import functools
import logging
import shlex
import typing
from collections.abc import Callable
from pathlib import Path

import yaml

from mjx_walk import zoo
from mjx_walk.algos import Algorithm, OffPolicyConfig, make_algorithm
from mjx_walk.cli.parsing import refuse_flags
from mjx_walk.envs import BUILT_IN_TASKS, TASKS, BaseTask, register_task, require_model
from mjx_walk.envs.registry import task_name
from mjx_walk.evaluation.gymnasium_scores import (
    Episodes,
    ScoreRequest,
    compile_episodes,
    score_in_gymnasium,
    score_in_sim,
)
from mjx_walk.evaluation.saved_policies import SavedPolicy, deterministic_policy, make_task
from mjx_walk.logs.loggers import require_wandb
from mjx_walk.logs.metrics import Row, read_rows
from mjx_walk.machine.compat import prepare_jax, standard_settings, temporary_jax_settings
from mjx_walk.machine.signals import as_by_ctrl_c
from mjx_walk.settings.config import Config, load_config
from mjx_walk.settings.overrides import key_of_value
from mjx_walk.settings.own_tasks import KEY
from mjx_walk.settings.trust import remember
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.saved_yaml import read_yaml
from mjx_walk.storage.scores import BEST, Scores
from mjx_walk.training.checks import as_saved, check_replay, prepared
from mjx_walk.training.distributed import Processes, per_device
from mjx_walk.training.init_from import read_networks
from mjx_walk.training.messages import announce, resume_command
from mjx_walk.training.trainer import Trainer
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import validate
from mjx_walk.viewing.rendering import choose_opengl

__all__ = ["Run", "load_run", "resolve", "resolve_seeds", "run", "train"]

_LOGGER = logging.getLogger(__name__)


class Run(SavedPolicy):
    """A run on disk: its configuration, metrics and one of its policies."""

    _NOT_PICKLED = (*SavedPolicy._NOT_PICKLED, "_episodes")

    @functools.cached_property
    def metrics(self) -> list[Row]:
        """All rows of `metrics.jsonl`; none for a policy of the zoo, which has no such file.

        Raises:
            UserError: the file is gone, or cannot be read.
        """
        path = RunFolder(self.path).metrics
        if not path.exists() and not zoo.holds(self.path):
            raise UserError(f"{path} is missing; restore it, or load the run from the folder that has it")
        return read_rows(path)

    @standard_settings()
    def evaluate(self, episodes: int = 100, backend: str = "gymnasium", seed: int = 0) -> Scores:
        """Score the deterministic policy that `load_run` has loaded: by default the best one.

        The command `eval` scores the final one by default.

        Args:
            episodes: number of episodes.
            backend: `gymnasium`, the real environment, or `sim`, the engine that the run was loaded with. Both score
                Gymnasium's reward, `sim` with the run's shaping. A run's `reward_function` is not loaded. A task of
                your own has no equivalent in Gymnasium: both backends score it in the engine.
            seed: in Gymnasium, episode i is reset with `seed + i`, so that `gymnasium.make(…).reset(seed=seed + i)`
                starts it. Seeds that differ by fewer than `episodes` share episodes: after 0, take 100 for 100 others.
                With `sim`, every seed has episodes of its own.

        Raises:
            UserError: an invalid argument.
        """
        validate(ScoreRequest(episodes, backend, seed))
        if backend == "gymnasium" and self.task.is_in_gymnasium:
            return score_in_gymnasium(self.task, self.act, episodes, seed)
        if self.reward_function:
            _LOGGER.warning("scoring with Gymnasium's reward: the run's own, %s, is not loaded", self.reward_function)
        return score_in_sim(self.task, self._episodes, episodes, seed)

    @functools.cached_property
    def _episodes(self) -> Episodes:
        return compile_episodes(self.task, deterministic_policy(self.algorithm, self.policy_params))


def load_run(
    path: str | Path, physics: str | None = None, policy: str = BEST, task: type[BaseTask] | None = None
) -> Run:
    """Load a run.

    Args:
        path: its folder, or `zoo:NAME`.
        physics: engine to use instead of the run's own.
        policy: `best`, the policy with the highest evaluation during training or at its end, or `final`, the newest
            one. `eval` takes `final` by default; `play` and `export` take `best`, as here. A training with
            `checkpoint.milestones` also keeps `medium` and `simple`.
        task: the run's task, if it is your own or of another library, and neither registered nor in a file that you
            trust.

    Raises:
        UserError: no run, or no usable policy at that path.
    """
    prepare_jax()
    folder = zoo.open_run(path)
    if task is not None:
        _register_for(folder, task)
    return Run(folder, physics, policy)


def _register_for(folder: RunFolder, task: type[BaseTask]) -> None:
    """Register a task under the name that a run has for its own."""
    try:
        name = str(read_yaml(folder.config_copy() or folder.config).env.name)
    except (OSError, ValueError, LookupError, AttributeError, RecursionError, yaml.YAMLError):
        return  # loading the run reports the error
    if name in BUILT_IN_TASKS:
        raise UserError(f"{folder.path} was trained on {name}, a task of this package; leave out task=")
    register_task(name, task)


def resolve(overrides: list[str]) -> Config:
    """The configuration of a command line. `resume=true` with only a folder continues with the saved configuration.

    Raises:
        UserError: invalid overrides.
    """
    return as_saved(load_config(overrides), overrides)


def resolve_seeds(overrides: list[str], seeds: list[int]) -> list[Config]:
    """The configurations of a command line for several seeds, each with the folder `seed_N` in a given `run_dir`.

    Raises:
        UserError: invalid overrides.
    """
    if any(override.startswith("seed=") for override in overrides):
        raise UserError("give seed=N or seeds=[…], not both")
    config = load_config(overrides)
    if config.run_dir is None and config.resume:
        raise UserError("resume=true needs run_dir=PATH of the folder that holds the seeds")
    with_seeds = [dataclasses.replace(config, seed=seed) for seed in seeds]
    for one in with_seeds:
        one.run_dir = str(Path(one.run_dir, f"seed_{one.seed}")) if one.run_dir is not None else None
    return [as_saved(one, overrides) for one in with_seeds]


def train(
    configs: list[Config],
    on_metrics: Callable[[Row], None] | None = None,
    processes: Processes | None = None,
    runs: Path = Path("runs"),
) -> tuple[list[RunFolder], str | None]:
    """Train one run, or several that differ only in their seed, and score them in the real Gymnasium.

    JAX's settings are restored at the end.

    Args:
        configs: checked configurations, equal except for `seed` and `run_dir`.
        on_metrics: called with every logged row.
        processes: the processes that train one run together, including this one.
        runs: the folder for the folders of runs without `run_dir`.

    Returns:
        The run folders, and the name of the signal that stopped training early, if one did.

    Raises:
        UserError: the run does not fit this machine, or a folder or its run does not fit the configuration.
    """
    require_wandb(configs[0])
    if configs[0].evaluation.films:
        if configs[0].env.name not in BUILT_IN_TASKS and not configs[0].env.task:
            raise UserError(f"evaluation.films=true films in another process; name the task as {KEY}=FILE.py:CLASS")
        choose_opengl()
    physics = TASKS[configs[0].env.name][0].resolve_physics(configs[0].physics)
    configs = [dataclasses.replace(config, physics=physics) for config in configs]
    processes = processes or Processes()
    with temporary_jax_settings(configs[0].matmul_precision), contextlib.ExitStack() as closing:
        task = make_task(configs[0])
        closing.callback(task.engine.preparation.cancel)
        if configs[0].evaluation.films:
            require_model(task)
        if task.reward_hashes and processes.is_main_process:
            remember(configs[0].env.reward_function, task.reward_hashes)
        algorithm = _make_algorithm(configs[0], task, processes)
        networks = read_networks(configs[0], algorithm)
        folders, configs = _prepare(configs, algorithm, processes, closing, runs)
        trainer = Trainer(configs, algorithm, folders, processes, on_metrics, networks)
        with as_by_ctrl_c(), contextlib.closing(trainer):
            signal_name = trainer.train()
            if not signal_name:
                _score(trainer, folders)
            elif processes.is_main_process:
                _LOGGER.info("Stopped by %s and saved. To continue: %s", signal_name, resume_command(configs, folders))
    return folders, signal_name


def _make_algorithm(config: Config, task: BaseTask, processes: Processes) -> Algorithm:
    """The algorithm of a run on this process's device."""
    evaluation = per_device(config.evaluation, processes.process_count)
    algo = per_device(config.algo, processes.process_count)
    if config.init_from and isinstance(algo, OffPolicyConfig) and algo.random_steps is None:
        algo = dataclasses.replace(algo, random_steps=0)  # its policy acts from the start
    return make_algorithm(task, config.num_envs, evaluation, algo, processes.axis_name)


def _prepare(
    configs: list[Config], algorithm: Algorithm, processes: Processes, closing: contextlib.ExitStack, runs: Path
) -> tuple[list[RunFolder], list[Config]]:
    """Check that the runs fit this machine, and prepare their folders. All processes get the main one's folder.

    The main process locks the folders until `closing` is closed.
    """
    replay = check_replay(algorithm, Path(configs[0].run_dir or "."), len(configs))
    folders: list[RunFolder] = []
    if processes.is_main_process:
        folders, configs = closing.enter_context(prepared(configs, runs))
        announce(configs[0], folders, processes.process_count)
        if replay:
            _LOGGER.info(replay)
    if processes.process_count > 1:
        path = str(folders[0].path.absolute()) if folders else ""
        folders = [RunFolder(Path(processes.broadcast_one_to_all(path)))]
    return folders, configs


def _score(trainer: Trainer, folders: list[RunFolder]) -> None:
    try:
        trainer.score()
    except KeyboardInterrupt:
        for folder in folders:
            if not folder.gymnasium_scores.exists():
                where = shlex.quote(f"run={folder.path}")
                _LOGGER.info("Trained and saved, not scored. To score: python -m mjx_walk.eval %s", where)
        raise


def run(
    overrides: list[str] | None = None,
    on_metrics: Callable[[Row], None] | None = None,
    task: type[BaseTask] | None = None,
) -> Run:
    """Train as `python -m mjx_walk.train` does, from Python.

    Messages and progress go to the logger `mjx_walk`, at level INFO.

    Args:
        overrides: arguments of the command, such as `["env=walker2d", "total_steps=1_000_000"]`.
        on_metrics: called with every logged row.
        task: a class of your own to train on, in place of `env=`, or the result of `from_brax` or `from_gymnax`.
            `MyRobot` is registered as `my_robot`.

    Raises:
        UserError: invalid overrides, or a run that cannot be trained here.
    """
    prepare_jax()
    if isinstance(overrides, str | dict):
        raise UserError(f"overrides={overrides!r}: give a list, such as ['env=walker2d', 'seed=1']")
    overrides = [str(override) for override in overrides or []]
    refuse_flags(overrides, key_of_value, typing.get_type_hints(Config))
    if task is not None:
        overrides = _with_task(overrides, task)
    folders, _ = train([_in_absolute_folder(resolve(overrides))], on_metrics, runs=Path("runs").absolute())
    return load_run(folders[0].path)


def _in_absolute_folder(config: Config) -> Config:
    """A configuration whose run folder stays the same one if the program changes its working directory."""
    return dataclasses.replace(config, run_dir=config.run_dir and str(Path(config.run_dir).absolute()))


def _with_task(overrides: list[str], task: type[BaseTask]) -> list[str]:
    """Register a task, and name it in the overrides. A resume takes the name from its saved configuration."""
    for override in overrides:
        if override.partition("=")[0] in ("env", KEY):
            raise UserError(f"give task= or {override}, not both")
    if isinstance(task, str):
        raise UserError(f"task={task!r}: give a class; for a task by its name, add 'env={task}' to the overrides")
    if not isinstance(task, type):
        raise UserError(
            f"task= is an object of the class {type(task).__name__}: give a class; for an environment of another "
            "library, give mjx_walk.from_brax(env) or mjx_walk.from_gymnax(env)"
        )
    name = task_name(task)
    register_task(name, task)
    return overrides if "resume=true" in overrides else [f"env={name}", *overrides]
