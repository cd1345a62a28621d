"""The first and the last lines of a training, and the lines about the policies that it keeps."""

import logging
import shlex
from collections.abc import Mapping

import jax.numpy as jnp

from mjx_walk.algos import TrainState, learned_leaves
from mjx_walk.envs import TASKS, Task
from mjx_walk.machine.devices import default_device
from mjx_walk.settings.config import Config
from mjx_walk.settings.own_tasks import KEY
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, FINAL, Scores
from mjx_walk.utils.text import duration

__all__ = ["announce", "choice_line", "divergence", "end_lines", "resume_command", "say_length", "score_lines"]

_LOGGER = logging.getLogger(__name__)


def resume_command(configs: list[Config], folders: list[RunFolder]) -> str:
    """The command that continues the runs of a process, which differ in their seed."""
    where = shlex.quote(f"run_dir={folders[0].path}")
    if len(folders) > 1:
        where = f"{shlex.quote(f'run_dir={folders[0].path.parent}')} 'seeds={[config.seed for config in configs]}'"
    env = configs[0].env
    named = {KEY: env.task, "env.reward_function": env.reward_function, "wandb_project": configs[0].wandb_project}
    again = "".join(f" {shlex.quote(f'{key}={value}')}" for key, value in named.items() if value)
    return f"python -m mjx_walk.train {where} resume=true{again}"


def announce(config: Config, folders: list[RunFolder], num_devices: int) -> None:
    """Log what is trained where, and what may surprise the user.

    Args:
        config: of the first run.
        folders: of all runs.
        num_devices: devices that train one run together.
    """
    device = default_device()
    where = device.device_kind if device.platform != "cpu" else "the CPU"
    where = where if num_devices == 1 else f"{num_devices} × {where}, one process each"
    path = folders[0].path if len(folders) == 1 else f"{len(folders)} folders of {folders[0].path.parent}"
    env, algo = config.env.name, config.algo
    _LOGGER.info("Training %s with %s on %s, physics=%s, in %s", env, algo.name, where, config.physics, path)
    if config.hardware == "cpu" and issubclass(TASKS[env][0], Task):
        _LOGGER.info(
            "JAX runs on the CPU: this is the recipe for a CPU. By default the physics is MuJoCo's C library. "
            "Expect a gait after minutes to tens of minutes; recipes for a GPU reach much higher scores."
        )
    if algo.learning_rate_schedule != "constant" and config.total_steps > algo.schedule_steps:
        _LOGGER.warning(
            "after algo.schedule_steps=%d the learning rate is zero; to learn until total_steps=%d, "
            "add algo.schedule_steps=%d",
            algo.schedule_steps,
            config.total_steps,
            config.total_steps,
        )
    if config.physics == "warp":
        _LOGGER.info("On the first run on a machine, Warp compiles its kernels, which takes half a minute or more.")
        if config.profile_calls > 1 and num_devices == 1:
            _LOGGER.warning("JAX's profiler has hung in a second recorded call of Warp on one GPU; use profile_calls=1")


def say_length(config: Config, env_steps: int, steps_per_call: int, is_complete: bool, has_reached: bool) -> None:
    """Log whether the run is already complete, or whether `total_steps` is rounded up.

    Args:
        config: of the run.
        env_steps: environment steps of the complete training.
        steps_per_call: environment steps of a call.
        is_complete: whether the run has had them all.
        has_reached: whether the run has reached its `stop_at_return`.
    """
    if is_complete:
        _LOGGER.info(f"The run has already completed its {env_steps:,} steps; to continue, give a larger total_steps")
    elif has_reached:
        goal = f"stop_at_return={config.stop_at_return:,}"
        _LOGGER.info(f"The run has already reached {goal}; to continue, give a higher one, or stop_at_return=null")
    elif env_steps != config.total_steps:
        total = f"total_steps={config.total_steps:,}"
        _LOGGER.info(f"{total} is rounded up to {env_steps:,}: a call has {steps_per_call:,} steps")


def divergence(states: list[TrainState], seeds: list[int], env_steps: int) -> str:
    """Name the runs that have diverged, each with its first learned leaf that is not finite.

    Args:
        states: of the runs that train together, without the replay.
        seeds: their seeds.
        env_steps: their environment steps.
    """
    found = []
    for seed, state in zip(seeds, states, strict=True):
        names = [name for name, leaf in learned_leaves(state).items() if not jnp.isfinite(leaf).all()]
        found += [f"{name} of seed {seed}" for name in names[:1]]
    return (
        f"training has diverged: after {env_steps:,} steps {', '.join(found)} is not finite; "
        "earlier checkpoints are kept; start a new run with a lower learning rate, or clip gradients"
    )


def score_lines(
    scored: Mapping[str, tuple[Scores, int]], total_steps: int | None = None, seed: int | None = None
) -> list[str]:
    """One line for each scored policy, followed by one with its measures if it has any.

    Args:
        scored: scores and environment steps of each policy, by its name.
        total_steps: environment steps of the complete training.
        seed: the run's seed, if several runs were trained together.
    """
    whose = "" if seed is None else f"seed {seed}, "
    end = "" if total_steps is None else f" of {total_steps:,}"
    lines = []
    for name, (scores, steps) in scored.items():
        line = f"{whose}{name} policy (step {steps:,}{end}), {scores}"
        lines.append(line[0].upper() + line[1:])
        if scores.measures:
            lines.append(f"  {scores.measures_line}")
    return lines


def choice_line(taken: str) -> str:
    """Message of a command that has chosen one of a run's two policies by itself.

    Args:
        taken: `final` or `best`.
    """
    if taken == FINAL:
        return f"The final policy is the newest one. play, export and load_run take the best one: policy={BEST}"
    return f"The best policy has the highest evaluation during training. eval scores the final one: policy={FINAL}"


def end_lines(
    folders: list[RunFolder], training_seconds: float, total_seconds: float, is_scored: bool, has_model: bool
) -> list[str]:
    """The time, the folder, and the next command.

    Args:
        folders: folders of the runs that were trained together.
        training_seconds: seconds of training, without scoring.
        total_seconds: seconds of training and scoring.
        is_scored: whether the policies were scored.
        has_model: whether the task has a model to draw.
    """
    time = duration(total_seconds)
    if is_scored:
        time = f"{time}, of which training took {duration(training_seconds)}"
    path = folders[0].path
    where = str(path) if len(folders) == 1 else f"{len(folders)} folders of {path.parent}"
    run = shlex.quote(f"run={path}")
    if not has_model:
        next_step = f"To load the best policy: mjx_walk.load_run({str(path)!r}, task=…)"
    elif is_scored:
        next_step = f"To watch the best policy: python -m mjx_walk.play {run}"
    else:
        next_step = f"To score: python -m mjx_walk.eval {run}"
    return [f"Finished in {time}. The results are in {where}", next_step]
