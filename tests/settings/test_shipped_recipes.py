"""Shipped recipes: every one composes and fits its algorithm."""

import functools
from pathlib import Path

import pytest
import yaml

from mjx_walk.algos import ALGORITHMS, make_algorithm
from mjx_walk.api import make_task
from mjx_walk.envs import GYMNASIUM_TASKS
from mjx_walk.settings.config import CONFIG_DIR, load_config, recipe_names
from mjx_walk.settings.recipes import HARDWARE, fallback
from mjx_walk.utils.setting_fields import has_effect

RECIPES = [f"{size}/{env}_{algo}" for size in HARDWARE for env in GYMNASIUM_TASKS for algo in ALGORITHMS]
FOLDER = Path(CONFIG_DIR) / "recipe"
FILES = sorted(str(path.relative_to(FOLDER).with_suffix("")) for path in FOLDER.glob("*/[!_]*.yaml"))

LONGER_SCHEDULES = {"cpu/humanoid_ppo": 3_000_000}
"""Of the recipes that end before their schedule. All others anneal to the end."""

MIN_CALLS = {"gpu/inverted_pendulum_ppo": 14, "gpu/inverted_double_pendulum_ppo": 14}
"""Of the recipes that have fewer than 20 calls."""

SCHEDULES = ("learning_rate_schedule", "entropy_schedule", "final_discount", "final_target_entropy")


def parts_of(recipe):
    """Hardware, environment and algorithm of `HARDWARE/ENV_ALGO`. All names may have underscores."""
    hardware, _, name = recipe.partition("/")
    algo = max((algo for algo in ALGORITHMS if name.endswith(f"_{algo}")), key=len)
    return hardware, name.removesuffix(f"_{algo}"), algo


@functools.cache
def load_recipe(recipe):
    """Composing takes a tenth of a second."""
    folder, task = recipe.partition("/")[0], []
    if folder != "report":
        _, env, algo = parts_of(recipe)
        task = [f"env={env}", f"algo={algo}"]
    chosen = [f"hardware={folder}"] if recipe in RECIPES else [f"recipe={recipe}"]
    return load_config([*task, *chosen, "physics=c"])


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_fits(recipe):
    config = load_recipe(recipe)
    assert (config.hardware, config.env.name, config.algo.name) == parts_of(recipe)
    if any(getattr(config.algo, name, None) not in (None, "constant") for name in SCHEDULES):
        assert config.algo.schedule_steps == LONGER_SCHEDULES.get(fallback(recipe) or recipe, config.total_steps)
    algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, config.algo)
    assert algorithm.steps_per_iteration * config.iterations_per_call < config.total_steps / MIN_CALLS.get(recipe, 20)


@pytest.mark.parametrize("recipe", [name for name in FILES if not name.startswith("report/")])
def test_no_recipe_gives_a_setting_without_effect(recipe):
    """For the defaults of an algorithm, on Walker2d."""
    size, _, name = recipe.partition("/")
    config = load_recipe(recipe if "_" in name else f"{size}/walker2d_{name}")
    content = yaml.safe_load((FOLDER / f"{recipe}.yaml").read_text())
    content.pop("defaults", None)
    given = [f"{key}.{name}" for key, value in content.items() if isinstance(value, dict) for name in value]
    given += [key for key, value in content.items() if not isinstance(value, dict)]
    assert given and [key for key in given if not has_effect(config, key)] == []


def test_a_task_without_a_recipe_takes_the_defaults_of_the_algorithm():
    """Under every name that a recipe has: alone, given, inherited from, and in a sweep."""
    assert fallback("gpu/ant_ppo") == "gpu/ppo" and fallback("gpu/swimmer_ppo") is None is fallback("gpu/ppo")
    base = ["env=ant", "algo=csac", "hardware=gpu"]
    expected = load_config([*base, "recipe=gpu/csac"])
    assert load_config(base) == load_config([*base, "recipe=gpu/ant_csac"]) == expected
    assert expected.algo.discount == 0.99 and expected.algo.reward_scale == 1.0
    assert {"gpu/ant_csac", "gpu/csac", "report/c_sac"} <= {*recipe_names()}


@pytest.mark.parametrize("name", sorted(path.stem for path in Path(CONFIG_DIR).glob("recipe/report/*.yaml")))
def test_the_reports_recipes_name_their_own_task_and_algorithm(name):
    config = load_config([f"recipe=report/{name}"])
    report, algo = name.split("_")[:2]
    task = {"a": "humanoid", "b": "humanoid", "c": "humanoid", "d": "humanoid_standup", "e": "walker2d"}[report]
    assert (config.algo.name, config.env.name) == (algo, task) and config.env.version == (
        "v5" if report == "e" else "v4"
    )
    algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, config.algo)
    assert algorithm.steps_per_iteration * config.iterations_per_call < config.total_steps / 20
    if name in ("c_sac", "d_ddpg", "d_sac", "e_td3"):
        assert config.evaluation.num_envs == 10 and algorithm.steps_per_iteration == config.num_envs


def test_the_recipe_for_speed_gathers_five_times_the_steps_and_goes_through_them_half_as_often():
    usual, fast = (load_config(["hardware=gpu", f"recipe={folder}/humanoid_ppo"]) for folder in ("gpu", "speed"))
    algorithms = [make_algorithm(make_task(c), c.num_envs, c.evaluation, c.algo) for c in (usual, fast)]
    assert algorithms[1].steps_per_iteration == 5 * algorithms[0].steps_per_iteration
    assert 2 * fast.algo.num_epochs == usual.algo.num_epochs and fast.algo.schedule_steps == fast.total_steps


def test_the_first_reports_observation_has_378_numbers():
    assert make_task(load_config(["recipe=report/a_a2c"])).observation_size == 378
