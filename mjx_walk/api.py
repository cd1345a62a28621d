"""What the commands, the notebook and the tests call: train a run, load a run."""

import dataclasses
import functools
import operator
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from mjx_walk import zoo
from mjx_walk.algos import make_algorithm
from mjx_walk.envs.physics import resolve_engine
from mjx_walk.evaluation.gymnasium_scores import Scores, score_in_gymnasium, score_in_sim
from mjx_walk.runs import run_folder
from mjx_walk.runs.config import Config, compile_cache_dir, load_config, present_key, read_config
from mjx_walk.runs.loggers import require_wandb
from mjx_walk.runs.metrics import Row, read_rows
from mjx_walk.runs.policies import SavedPolicy, make_task
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.training.distributed import Processes
from mjx_walk.training.memory_check import check_replay
from mjx_walk.training.trainer import Trainer
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.signals import as_by_ctrl_c
from mjx_walk.viewing.rendering import choose_opengl


class Run(SavedPolicy):
    """A run on disk: its configuration, its metrics and its best policy."""

    @functools.cached_property
    def metrics(self) -> list[Row]:
        """All rows of `metrics.jsonl`."""
        return read_rows(self.path / "metrics.jsonl")

    def evaluate(self, episodes: int = 100, backend: str = "gymnasium", seed: int = 0) -> Scores:
        """Score the policy without noise; `backend` is `gymnasium` or `sim`, the run's own engine."""
        if backend == "gymnasium":
            return score_in_gymnasium(self.task, self.act, episodes, seed)
        policy = self.algorithm.policy(self.policy_params, deterministic=True)
        return score_in_sim(self.task, policy, episodes, seed)


def load_run(path: str | Path, physics: str | None = None) -> Run:
    """Load a run from its folder.

    Raises:
        UserError: no run, or no usable policy there.
    """
    return Run(zoo.open_run(path), physics)


def resolve(overrides: list[str]) -> Config:
    """The configuration that a command line asks for. `resume=true` with nothing but the folder takes the run's own.

    Raises:
        UserError: anything wrong in it.
    """
    return _as_saved(load_config(overrides), overrides)


def resolve_seeds(overrides: list[str], seeds: list[int]) -> list[Config]:
    """The same for several seeds, each in a folder `seed_N` of `run_dir`.

    Raises:
        UserError: anything wrong in it.
    """
    if any(override.startswith("seed=") for override in overrides):
        raise UserError("give seed=N or seeds=[…], not both")
    config = load_config(overrides)
    if config.run_dir is None and config.resume:
        raise UserError("resume=true needs run_dir=PATH of the folder that holds the seeds")
    parent = Path(config.run_dir or run_folder.new_path(config))
    with_seeds = (dataclasses.replace(config, seed=seed, run_dir=str(parent / f"seed_{seed}")) for seed in seeds)
    return [_as_saved(config, overrides) for config in with_seeds]


def train(
    configs: list[Config], on_metrics: Callable[[Row], None] | None = None, processes: Processes | None = None
) -> tuple[list[RunFolder], str | None]:
    """Train one run, or several that differ in their seed alone side by side; then score them in the real Gymnasium.

    Args:
        configs: checked configurations, alike but for `seed` and `run_dir`.
        on_metrics: called with every row that is logged.
        processes: that train one run together; this is one of them.

    Returns:
        The run folders, and the name of the signal that stopped them early, if one did.
    """
    require_wandb(configs[0])
    if configs[0].evaluation.films:
        choose_opengl()
    physics = resolve_engine(configs[0].physics)
    configs = [dataclasses.replace(config, physics=physics) for config in configs]
    jax.config.update("jax_default_matmul_precision", configs[0].matmul_precision)
    jax.config.update("jax_compilation_cache_dir", compile_cache_dir())
    task = make_task(configs[0])
    # Refuses what does not fit before a folder is made.
    algorithm = make_algorithm(task, configs[0].num_envs, configs[0].evaluation, configs[0].algo)
    replay = check_replay(algorithm, Path(configs[0].run_dir or "."), len(configs))
    processes = processes or Processes()
    if processes.is_main_process:
        folders, configs = run_folder.prepare(configs)
        _announce(configs[0], folders, processes.process_count)
        if replay:
            print(replay, flush=True)
    if processes.process_count > 1:
        path = str(folders[0].path.absolute()) if processes.is_main_process else ""
        folders = [RunFolder(Path(processes.broadcast_one_to_all(path)))]
    trainer = Trainer(configs, task, folders, on_metrics, processes)
    with as_by_ctrl_c():
        signal_name = trainer.train()
        if signal_name and processes.is_main_process:
            where = f"run_dir={folders[0].path}"
            if len(folders) > 1:
                where = f"run_dir={folders[0].path.parent} 'seeds={[config.seed for config in configs]}'"
            print(
                f"Stopped by {signal_name} and saved. To go on: python -m mjx_walk.train {where} resume=true",
                flush=True,
            )
        elif not signal_name:
            try:
                trainer.score()
            except KeyboardInterrupt:
                for folder in folders:
                    if not folder.gymnasium_scores.exists():
                        print(f"Trained and saved, not scored. To score: python -m mjx_walk.eval run={folder.path}")
                raise
    return folders, signal_name


def run(overrides: list[str] | None = None, on_metrics: Callable[[Row], None] | None = None) -> Run:
    """Train as `python -m mjx_walk.train` would, from Python.

    Args:
        overrides: `["env=walker2d", "total_steps=1_000_000"]`.
        on_metrics: called with every row that is logged.

    Raises:
        UserError: anything wrong in the overrides.
    """
    folders, _ = train([resolve(overrides or [])], on_metrics)
    return load_run(folders[0].path)


def _as_saved(config: Config, overrides: list[str]) -> Config:
    """A run's own configuration, with the settings that were given to resume it, unless those say which run it is."""
    given = {present_key(override.partition("=")[0]) for override in overrides}
    if not (config.resume and config.run_dir) or given & {"env", "algo", "recipe"}:
        return config
    saved = read_config(run_folder.open_existing(config.run_dir).config)
    for key in given - {"hardware"} | {"run_dir", "resume"}:
        saved = _with_setting(saved, key, operator.attrgetter(key)(config))
    return saved


def _with_setting(settings: Any, key: str, value: Any) -> Any:
    """The same dataclass with another value at a key such as `evaluation.films`."""
    name, _, rest = key.partition(".")
    own = _with_setting(getattr(settings, name), rest, value) if rest else value
    return dataclasses.replace(settings, **{name: own})


def _announce(config: Config, folders: list[RunFolder], num_devices: int) -> None:
    device = jax.devices()[0]
    where = device.device_kind if device.platform != "cpu" else "the CPU"
    where = where if num_devices == 1 else f"{num_devices} × {where}, a process each"
    path = folders[0].path if len(folders) == 1 else f"{len(folders)} folders of {folders[0].path.parent}"
    print(f"Training {config.env.name} with {config.algo.name} on {where}, physics={config.physics}, in {path}")
    if config.hardware == "cpu":
        print(
            "No accelerator: the CPU-sized recipe, with MuJoCo's C library unless another engine was asked for. "
            "Expect minutes to tens of minutes to a gait; recipes for a GPU reach much higher scores.",
        )
    algo = config.algo
    if algo.learning_rate_schedule != "constant" and config.total_steps > algo.schedule_steps:
        print(
            f"warning: from algo.schedule_steps={algo.schedule_steps} on the learning rate is zero; to learn until "
            f"total_steps={config.total_steps} give algo.schedule_steps={config.total_steps}, too",
            file=sys.stderr,
        )
    if config.physics == "warp":
        print("Warp compiles its kernels on the first run of a machine, which takes about a minute.")
    sys.stdout.flush()
