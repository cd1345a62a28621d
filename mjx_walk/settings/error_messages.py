"""The errors of Hydra and OmegaConf about a command line, in one line that says what to type instead."""

import re
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override

from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.envs.task_options import OPTION_PRESETS
from mjx_walk.settings.recipe_files import recipe_file, recipe_settings
from mjx_walk.settings.recipes import fitting_recipes, recipe_names
from mjx_walk.settings.schema import chosen, setting_types
from mjx_walk.utils.errors import first_line
from mjx_walk.utils.near_misses import near_misses
from mjx_walk.utils.value_types import plain_type, type_mistake

__all__ = ["explain", "unknown_key"]

_ELSEWHERE = {
    "algo": ("algorithm",),
    "algo.clip_epsilon": ("clip_range",),
    "algo.discount": ("gamma",),
    "algo.learning_rate": ("lr",),
    "algo.num_epochs": ("n_epochs",),
    "algo.policy_hidden_layer_sizes": ("hidden_sizes", "net_arch"),
    "env": ("env_id", "env_name", "environment"),
    "num_envs": ("n_envs",),
    "run_dir": ("folder", "out", "run"),
    "total_steps": ("steps", "timesteps", "total_timesteps"),
    "wandb_project": ("wandb",),
}
"""The names that other libraries and other commands have for our keys."""
_GROUPS = ("hardware", "recipe")
"""Hydra's groups that are not settings."""
_MOST_LISTED = 8
"""Most settings of a group that a message lists."""
_UNKNOWN_KEY = re.compile("not in struct|not in '|Could not override")


def explain(error: BaseException, overrides: list[Override]) -> str:
    """The line for an error. The useful detail is often in its cause.

    Args:
        error: what composing the configuration has raised.
        overrides: the command line, as `read_overrides` returns it.
    """
    given = {override.key_or_group: str(override.input_line).partition("=")[2] for override in overrides}
    env, algo = chosen(given)
    types = setting_types(env, algo)
    texts = [str(error), str(error.__cause__ or "")]
    if "raised while composing config" in texts[0]:
        return _unfit_recipe(texts[0], given, env, algo)
    if any(_UNKNOWN_KEY.search(text) for text in texts):
        wrong = [key for key in given if key not in types and key not in _GROUPS]
        if wrong:
            return unknown_key(wrong[0], env, algo)
    missing = re.search(r"Could not find '(\w+)/(.*?)'", texts[0])
    if missing and missing[1] in _GROUPS:
        return _unknown_choice(missing[1], missing[2], env, algo)
    sweep = re.search(r"(?:Ambiguous value for argument|Sweep parameters) '(.*?)=(.*)'", texts[0])
    if sweep:
        return _several_values(sweep[1], sweep[2], types)
    full_key = getattr(error, "full_key", None) or getattr(error.__cause__, "full_key", None)
    key = re.sub(r"\[\d+\]$", "", full_key or "")
    detail = first_line(error.__cause__ or error)
    if key not in given or "Interpolation" in detail:
        return f"{full_key}: {detail}" if full_key else detail
    return type_mistake(key, given[key], types.get(key)) or f"{key}={given[key]}: {detail}"


def unknown_key(key: str, env: str, algo: str) -> str:
    """The error for a key that no setting has, with the settings that may be meant.

    Args:
        key: the key.
        env: name of the task.
        algo: name of the algorithm.
    """
    types = setting_types(env, algo)
    groups = [known for known, hint in types.items() if hasattr(plain_type(hint), "__dataclass_fields__")]
    section, _, name = key.rpartition(".")
    settings = [known for known in types if known not in groups]
    owners = _owners(section, name)
    if owners and owners[0] not in settings:
        full, having = owners
        owner = algo if full.startswith("algo.") else env
        return f"unknown key '{key}'; {full} is a setting of {', '.join(having)}, not of {owner}"
    near = _similar(key, settings)
    if near:
        return f"unknown key '{key}'; did you mean: {', '.join(near)}?"
    own = [known for known in types if known.rpartition(".")[0] == section and section]
    if own and len(own) <= _MOST_LISTED:
        return f"unknown key '{key}'; choose one of: {', '.join(own)}"
    return f"unknown key '{key}'; for the settings, see: python -m mjx_walk.train env={env} algo={algo} --cfg job"


def _similar(key: str, known: list[str]) -> list[str]:
    """The known keys that a key may stand for."""
    name = key.rpartition(".")[2]
    same = [ours for ours, others in _ELSEWHERE.items() if name in others and ours in (*known, "env", "algo")]
    same = same or [other for other in known if other.rpartition(".")[2] == name]
    if same:
        return same
    last = {other.rpartition(".")[2]: other for other in known}
    near = [*near_misses(key, known, 3, 0.75), *(last[other] for other in near_misses(name, last, 2, 0.75))]
    return list(dict.fromkeys(near))


def _owners(section: str, name: str) -> tuple[str, list[str]] | None:
    """The full key of a setting that other algorithms or tasks have, and their names."""
    tables: dict[str, dict[str, Any]] = {
        "algo": {algo: config for algo, (_, config) in ALGORITHMS.items()},
        "env": {env: options for env, (_, options) in TASKS.items()},
    }
    for group, schemas in tables.items():
        having = [owner for owner, schema in schemas.items() if name in schema.__dataclass_fields__]
        if having and section in ("", group):
            return f"{group}.{name}", having
    return None


def _unfit_recipe(text: str, given: dict[str, str], env: str, algo: str) -> str:
    """The error for a recipe that sets what the algorithm or the task lacks: the first line names its file."""
    file = re.search(r"recipe/([\w/-]+)", text)
    recipe = given.get("recipe") or (file[1] if file else "")
    own = recipe_file(recipe.strip("'")) if recipe else None
    if own:
        return _mistake_in_file(own, text, env, algo)
    name = recipe.rpartition("/")[2]
    meant_algo = max((known for known in ALGORITHMS if name.endswith(f"_{known}")), key=len, default=algo)
    meant_env = name.removesuffix(f"_{meant_algo}")
    meant = [f"env={meant_env}"] if meant_env in TASKS and meant_env != env else []
    meant += [f"algo={meant_algo}"] if meant_algo != algo else []
    hint = f"add {' '.join(meant)}" if meant else fitting_recipes(env, algo)
    return f"recipe={recipe} does not fit env={env} algo={algo}; {hint}"


def _mistake_in_file(recipe: Path, text: str, env: str, algo: str) -> str:
    """The error for a recipe file of the user: an unknown key, or a value of another type."""
    settings = list(recipe_settings(recipe))
    choices = {"/env": env, "/algo": algo} | {key: value for _, key, value in settings if key.startswith("/")}
    env, algo = choices["/env"], choices["/algo"]
    types = setting_types(env, algo)
    for file, key, value in settings:
        if key in ("env", "algo", "hardware"):
            return f"{file} sets {key}: {value}; write '- override /{key}: {value}' below 'defaults:'"
        if key.removeprefix("env.") in OPTION_PRESETS:
            return f"{file}: {key}={value} is for the command line; write the settings of {key} into the file"
        if key not in types and not key.startswith("/"):
            return f"{file}: {unknown_key(key, env, algo)}"
    for file, key, value in settings:
        if f"full_key: {key}\n" in f"{text}\n":
            return f"{file}: {type_mistake(key, str(value), types[key]) or f'{key}: {value} is not valid'}"
    return f"{recipe} does not fit env={env} algo={algo}: {text.splitlines()[-1].strip()}"


def _unknown_choice(group: str, value: str, env: str, algo: str) -> str:
    """The error for a recipe, or a size of recipes, that does not exist."""
    if group == "hardware":
        return f"hardware={value}: choose one of: cpu, gpu"
    own = [name for name in recipe_names() if name.endswith(f"/{env}_{algo}")]
    near = near_misses(value, recipe_names())
    if not near or near[0] in own:
        near = [name for name in own if name.rpartition("/")[2] == value] or near_misses(value, own)
    hint = f"did you mean: {', '.join(near)}?" if near else fitting_recipes(env, algo)
    return f"unknown recipe '{value}'; {hint}"


def _several_values(key: str, text: str, types: dict[str, object]) -> str:
    """The error for several values, with commas or as `choice(1,2)`, outside a sweep."""
    mistake = type_mistake(key, text, types.get(key)) or ""
    if "; write " in mistake:
        return mistake
    alternative = f"write seeds=[{text}]" if key == "seed" and "(" not in text else "add -m"
    return f"{key}={text} gives several values; give one, or {alternative} to train a run with each"
