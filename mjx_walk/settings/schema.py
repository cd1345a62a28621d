"""The settings of a run, and their types."""

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from mjx_walk.algos import ALGORITHMS
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.envs import TASKS
from mjx_walk.envs.physics import ENGINES
from mjx_walk.utils.setting_fields import MAX_SEED, Dataclass, setting

__all__ = ["CheckpointConfig", "Config", "chosen", "leaves", "setting_types", "text_keys"]


@dataclasses.dataclass
class CheckpointConfig:
    """Settings of checkpoints."""

    every_calls: int = setting(50, at_least=1)
    """Program calls from one checkpoint to the next."""
    max_to_keep: int = setting(3, at_least=1)
    """Number of newest checkpoints to keep. Several seeds or devices keep one more until training ends. The best policy
    is kept separately."""
    milestones: bool = False
    """Also keep the policies `simple` and `medium`, about one and two thirds of the way from the return of the first
    policy to that of the best one. They are chosen at the end. Each checkpoint then holds up to 32 policies."""


@dataclasses.dataclass
class Config:
    """Settings of one training run."""

    env: Any = None
    """Options of the task, see `mjx_walk.envs`."""
    algo: Any = None
    """Settings of the algorithm, see `mjx_walk.algos`."""
    hardware: str = setting("gpu", choices=("gpu", "cpu"))
    """Size of the recipe. The default follows from the devices that JAX sees."""
    physics: str = setting("auto", choices=("auto", *ENGINES))
    """Physics engine, see `mjx_walk.envs.physics`."""
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)
    """Seed of all random numbers of the run."""
    num_envs: int = setting(8192, at_least=1, at_most=2**31 - 1)
    """Training environments on each device."""
    total_steps: int = setting(100_000_000, at_least=1)
    """Environment steps, summed over all environments and rounded up to a multiple of the steps of a call."""
    iterations_per_call: int = setting(1, at_least=1)
    """Iterations compiled into one program call. Logging, filming and saving happen between calls. With a single
    iteration, Warp records its kernels again in most calls, because arrays that the physics reads have moved."""
    run_dir: str | None = None
    """Folder of the run, by default `runs/ENV_ALGO/TIME`."""
    resume: bool = False
    """Continue the run in `run_dir` from its newest checkpoint."""
    init_from: str | None = None
    """Run folder or zoo:NAME whose networks the training begins with, with new optimizers and schedules."""
    stop_at_return: float | None = None
    """Mean return of an evaluation during training that ends it. With several seeds, each of them must reach it."""
    wandb_project: str | None = None
    """Weights & Biases project to log to."""
    profile_calls: int = setting(0, at_least=0)
    """Program calls to record with JAX's profiler, from the third one on, in the run folder's `profile`. TensorBoard
    and Perfetto show the recording. With Warp on one GPU, record only one: recording a second call has hung."""
    matmul_precision: str = setting("tensorfloat32", choices=("tensorfloat32", "float32"))
    """Precision of the networks' matrix products. The physics always uses float32."""
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)


def leaves(values: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested dictionaries, by their full keys.

    Args:
        values: dictionary with strings as keys.
        prefix: start of the full keys, such as `algo.`.
    """
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def chosen(given: Mapping[str, str]) -> tuple[str, str]:
    """The environment and the algorithm of a command line; the default where it names none that is known.

    Args:
        given: values of the command line by their keys.
    """
    env, algo = given.get("env", "humanoid"), given.get("algo", "ppo")
    return (env if env in TASKS else "humanoid"), (algo if algo in ALGORITHMS else "ppo")


def setting_types(env: str, algo: str) -> dict[str, object]:
    """The annotation of every setting and of every group of settings, by its full key.

    Args:
        env: name of the task.
        algo: name of the algorithm.
    """
    return {key: hint for key, hint, _ in _walk(Config, "", {"env": TASKS[env][1], "algo": ALGORITHMS[algo][1]})}


def text_keys(env: str, algo: str) -> set[str]:
    """Keys of the settings that hold any text: paths and names.

    Args:
        env: name of the task.
        algo: name of the algorithm.
    """
    settings = _walk(Config, "", {"env": TASKS[env][1], "algo": ALGORITHMS[algo][1]})
    return {key for key, hint, limits in settings if hint in (str, str | None) and "choices" not in limits}


def _walk(
    schema: Dataclass | type[Dataclass], prefix: str, groups: Mapping[str, type]
) -> Iterator[tuple[str, object, Mapping[str, object]]]:
    """The full key, the annotation and the limits of every setting and of every group of settings."""
    hints = typing.get_type_hints(schema)
    for field in dataclasses.fields(schema):
        key = prefix + field.name
        hint = groups.get(key, hints[field.name])
        yield key, hint, field.metadata
        if dataclasses.is_dataclass(hint):
            yield from _walk(hint, f"{key}.", groups)
