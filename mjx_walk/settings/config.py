"""The configuration of a run: how a command line becomes one, and back."""

import contextlib
import dataclasses
import shlex
from collections.abc import Iterator
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjx_walk import envs
from mjx_walk.settings.error_messages import explain
from mjx_walk.settings.overrides import read_overrides
from mjx_walk.settings.own_hydra import own_hydra
from mjx_walk.settings.recipe_files import with_paths, with_stored_recipes
from mjx_walk.settings.recipes import CONFIG_DIR, recipe_names
from mjx_walk.settings.schema import CheckpointConfig, Config, leaves
from mjx_walk.storage.files import user_path, working_folder
from mjx_walk.storage.run_folder import PREFIX
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import has_effect, in_yaml, refuse_ineffective, validate

__all__ = [
    "CONFIG_DIR",
    "CheckpointConfig",
    "Config",
    "compose_config",
    "composing",
    "flatten",
    "load_config",
    "load_recipe",
    "recipe_names",
    "to_config",
    "training_command",
    "with_absolute_paths",
]


def load_config(overrides: list[str]) -> Config:
    """Compose and check a configuration.

    Args:
        overrides: arguments of the command line, such as `["env=walker2d", "algo.discount=0.99"]`.

    Raises:
        UserError: invalid overrides, in one line that names the valid choices; or a given setting that has no effect,
            unless a run is resumed.
    """
    return compose_config(read_overrides(overrides))


def compose_config(overrides: list[Override], is_partial: bool = False) -> Config:
    """Compose and check a configuration.

    Args:
        overrides: as `read_overrides` returns them.
        is_partial: whether further settings follow, so that a given one may still get an effect.

    Raises:
        UserError: as for `load_config`.
    """
    with composing(overrides) as texts:
        config = to_config(compose("train", texts))
    config = with_absolute_paths(config, working_folder())
    if not (config.resume or is_partial):
        refuse_ineffective(config, (override.key_or_group for override in overrides))
    return config


@contextlib.contextmanager
def composing(overrides: list[Override]) -> Iterator[list[str]]:
    """Context manager in which Hydra composes configurations of this package, and its errors name what to type instead.

    Yields:
        The overrides as Hydra takes them.

    Raises:
        UserError: invalid overrides.
    """
    try:
        with own_hydra() as store, initialize_config_dir(CONFIG_DIR, version_base="1.3"):
            yield with_stored_recipes(overrides, store)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(with_paths(explain(error, overrides))) from error


def to_config(node: object) -> Config:
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
    source = config.init_from
    if source is not None and not source.startswith(PREFIX):
        source = str(folder / user_path(source))
    env = envs.with_absolute_paths(config.env, folder)
    config = dataclasses.replace(config, run_dir=run_dir, init_from=source, env=env)
    for key, value in flatten(config).items():
        if isinstance(value, str) and "${" in value:
            raise UserError(f"{key}={value}: '${{' names another setting; choose a name without it")
    return config


def flatten(config: Config) -> dict[str, object]:
    """All settings by their full keys, with values as in `config.yaml`."""
    return dict(leaves(OmegaConf.to_container(OmegaConf.structured(config))))


def load_recipe(arguments: list[str], total_steps: int) -> dict[str, object]:
    """The settings of a recipe, by their full keys, for a training of another length.

    Args:
        arguments: of the command line, which choose the recipe.
        total_steps: other settings may follow from it. The recipe's own is returned.
    """
    recipe = load_config(arguments)
    if recipe.total_steps == total_steps:
        return flatten(recipe)
    return flatten(load_config([*arguments, f"total_steps={total_steps}"])) | {"total_steps": recipe.total_steps}


def training_command(config: Config) -> str:
    """The shortest training command for a configuration: a recipe, and the settings that differ from it.

    A shell and Hydra read the values that they had.
    """
    given = [f"env={config.env.name}", f"algo={config.algo.name}"]
    usual = f"{config.hardware}/{config.env.name}_{config.algo.name}"
    recipes = [f"recipe={name}" for name in recipe_names() if Path(name).name == Path(usual).name and name != usual]
    own = flatten(config)
    commands = []
    for asked in (given, *([*given, recipe] for recipe in recipes)):
        settings = load_recipe([f"hardware={config.hardware}", *asked], config.total_steps)
        relevant = (key for key in sorted(own) if not key.startswith(_IRRELEVANT) and has_effect(config, key))
        differing = (key for key in relevant if own[key] != settings.get(key))
        commands.append([*asked, *(shlex.quote(f"{key}={in_yaml(own[key])}") for key in differing)])
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
