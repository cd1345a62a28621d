"""The configuration of a run: its schema, and how command lines and files become one."""

import dataclasses
import difflib
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjx_walk import envs
from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.envs.physics import ENGINES
from mjx_walk.runs.overrides import complete_overrides
from mjx_walk.runs.recipes import CONFIG_DIR, fitting_recipes, recipe_names
from mjx_walk.runs.renamed import present_overrides
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.files import user_path
from mjx_walk.utils.settings import has_effect, refuse_ineffective, setting, validate

__all__ = [
    "CONFIG_DIR",
    "CheckpointConfig",
    "Config",
    "compose_config",
    "flatten",
    "load_config",
    "recipe_names",
    "register_schemas",
    "to_config",
    "training_command",
    "with_absolute_paths",
]


@dataclasses.dataclass
class CheckpointConfig:
    """Settings of checkpoints."""

    every_calls: int = setting(50, at_least=1)
    """Program calls from one checkpoint to the next."""
    keep: int = setting(3, at_least=1)
    """Number of newest checkpoints to keep. Several seeds or devices keep one more until training ends. The best policy
    is kept separately."""


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
    seed: int = setting(0, at_least=0, at_most=2**32 - 1)
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
    wandb_project: str | None = None
    """Weights & Biases project to log to."""
    profile_calls: int = setting(0, at_least=0)
    """Program calls to record with JAX's profiler, from the third one on, in the run folder's `profile`. TensorBoard
    and Perfetto show the recording."""
    matmul_precision: str = setting("tensorfloat32", choices=("tensorfloat32", "float32"))
    """Precision of the networks' matrix products. The physics always uses float32."""
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)


def register_schemas() -> None:
    """Register the schema and the groups `env` and `algo` with Hydra."""
    store = ConfigStore.instance()
    store.store(name="schema", node=Config)
    for name, (_, options) in TASKS.items():
        store.store(group="env", name=name, node=options)
    for name, (_, settings) in ALGORITHMS.items():
        store.store(group="algo", name=name, node=settings)


def load_config(overrides: list[str]) -> Config:
    """Compose and check a configuration.

    Args:
        overrides: arguments of the command line, such as `["env=walker2d", "algo.discount=0.99"]`.

    Raises:
        UserError: invalid overrides, in one line that names the valid choices; or a given setting that has no effect,
            unless a run is resumed.
    """
    overrides = present_overrides(overrides)
    config = compose_config(overrides)
    if not config.resume:
        refuse_ineffective(config, (override.partition("=")[0] for override in overrides))
    return config


def compose_config(overrides: list[str]) -> Config:
    """Compose a configuration and check its ranges, but not whether the given settings have an effect.

    Args:
        overrides: as for `load_config`.

    Raises:
        UserError: invalid overrides.
    """
    overrides = complete_overrides(overrides)
    register_schemas()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
            node = compose("train", overrides)
        return with_absolute_paths(to_config(node), Path.cwd())
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(_one_line(error, overrides)) from error


def to_config(node: Any) -> Config:
    """Convert a composed OmegaConf node to checked dataclasses.

    Raises:
        UserError: a value is out of range.
    """
    config = OmegaConf.to_object(node)
    assert isinstance(config, Config)
    validate(config)
    return config


def with_absolute_paths(config: Config, folder: Path) -> Config:
    """A configuration whose files stay the same ones when the run is resumed from another working directory.

    `run_dir` may stay relative, because a resume names it.

    Args:
        config: as a user gives it.
        folder: what a relative path is relative to.

    Raises:
        UserError: a path has `${`, which a saved configuration cannot hold.
    """
    run_dir = str(user_path(config.run_dir)) if config.run_dir is not None else None
    config = dataclasses.replace(config, run_dir=run_dir, env=envs.with_absolute_paths(config.env, folder))
    for key, value in flatten(config).items():
        if isinstance(value, str) and "${" in value:
            raise UserError(f"{key}={value}: '${{' names another setting; choose a name without it")
    return config


def flatten(config: Config) -> dict[str, Any]:
    """All settings by their full keys, with values as in `config.yaml`."""

    def walk(value: Any, prefix: str):
        for key, item in value.items():
            if isinstance(item, dict):
                yield from walk(item, f"{prefix}{key}.")
            else:
                yield prefix + key, item

    return dict(walk(yaml.safe_load(OmegaConf.to_yaml(OmegaConf.structured(config))), ""))


def _first_line(error: BaseException) -> str:
    return next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _one_line(error: BaseException, overrides: list[str]) -> str:
    """The part of a Hydra error that helps the user. The useful detail is often in its cause."""
    texts = [str(error), str(error.__cause__ or "")]
    if "raised while composing config" in texts[0]:  # the first line names the file, the second the problem
        file, wrong = (line.strip() for line in texts[0].splitlines()[:2])
        return f"{file.partition(':')[0]}: {wrong}; this recipe does not fit the given env and algo"
    if any("not in struct" in text or "not in '" in text or "Could not override" in text for text in texts):
        valid = list(
            flatten(load_config([o for o in overrides if o.startswith(("env=", "algo=", "hardware=", "recipe="))]))
        )
        given = [override.split("=", 1)[0] for override in overrides]
        unknown = [key for key in given if key not in valid and key not in ("env", "algo", "recipe", "hardware")]
        if unknown:
            near = difflib.get_close_matches(unknown[0], valid, n=3, cutoff=0.4)
            section = unknown[0].rpartition(".")[0]
            choices = near or [key for key in valid if key.rpartition(".")[0] == section] or valid
            return f"unknown key '{unknown[0]}'; did you mean: {', '.join(choices)}?"
    if "Could not find 'recipe/" in texts[0]:
        chosen = dict(override.split("=", 1) for override in overrides if override.startswith(("env=", "algo=")))
        return f"{_first_line(error)}; {fitting_recipes(chosen.get('env', 'humanoid'), chosen.get('algo', 'ppo'))}"
    key = getattr(error, "full_key", None) or getattr(error.__cause__, "full_key", None)
    detail = _first_line(error.__cause__ or error)
    return f"{key}: {detail}" if key else detail


def training_command(config: Config) -> str:
    """The shortest training command for a configuration: a recipe, and the settings that differ from it."""
    given = [f"env={config.env.name}", f"algo={config.algo.name}"]
    usual = f"{config.hardware}/{config.env.name}_{config.algo.name}"
    recipes = [f"recipe={name}" for name in recipe_names() if Path(name).name == Path(usual).name and name != usual]
    own = flatten(config)
    commands = []
    for asked in (given, *([*given, recipe] for recipe in recipes)):
        settings = flatten(load_config([f"hardware={config.hardware}", *asked]))
        relevant = (key for key in sorted(own) if not key.startswith(_IRRELEVANT) and has_effect(config, key))
        commands.append([*asked, *(f"{key}={own[key]}" for key in relevant if own[key] != settings.get(key))])
    return " ".join(["python -m mjx_walk.train", *min(commands, key=len)])


_IRRELEVANT = (
    "hardware",
    "physics",
    "iterations_per_call",
    "run_dir",
    "resume",
    "wandb",
    "evaluation.",
    "checkpoint.",
)
"""Prefixes of settings that do not influence the trained policy."""
