"""Configurations: every recipe composes and fits its algorithm; what is saved is what is read."""

from pathlib import Path

import pytest

from mjx_walk.algos import ALGORITHMS, make_algorithm
from mjx_walk.api import make_task
from mjx_walk.envs import TASKS
from mjx_walk.runs.config import CONFIG_DIR, flatten, load_config, read_config, save_config

RECIPES = sorted(
    str(path.relative_to(f"{CONFIG_DIR}/recipe"))[:-5] for path in Path(CONFIG_DIR).glob("recipe/?pu/[!_]*.yaml")
)

SCHEDULES = ("learning_rate_schedule", "entropy_schedule", "final_discount", "final_target_entropy")


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_fits(recipe):
    hardware, _, name = recipe.partition("/")
    env, _, algo = name.rpartition("_")
    config = load_config([f"env={env}", f"algo={algo}", f"hardware={hardware}", "physics=c"])
    assert (config.env.name, config.algo.name, config.hardware) == (env, algo, hardware)
    if any(getattr(config.algo, name, None) not in (None, "constant") for name in SCHEDULES):
        assert config.algo.schedule_steps == config.total_steps  # annealed to the end, unless it is stopped early
    algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, config.algo)
    assert algorithm.steps_per_iteration * config.iterations_per_call < config.total_steps / 20


def test_there_is_a_recipe_for_every_task_on_every_hardware():
    assert len(RECIPES) == 2 * len(TASKS) * len(ALGORITHMS)


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


def test_the_recipe_for_speed_gathers_four_times_the_steps_and_goes_through_them_half_as_often():
    usual, fast = (load_config(["hardware=gpu", f"recipe={folder}/humanoid_ppo"]) for folder in ("gpu", "speed"))
    algorithms = [make_algorithm(make_task(c), c.num_envs, c.evaluation, c.algo) for c in (usual, fast)]
    assert algorithms[1].steps_per_iteration == 4 * algorithms[0].steps_per_iteration
    assert 2 * fast.algo.num_epochs == usual.algo.num_epochs and fast.algo.schedule_steps == fast.total_steps


def test_the_first_reports_observation_has_378_numbers():
    assert make_task(load_config(["recipe=report/a_a2c"])).observation_size == 378


def test_without_an_accelerator_the_small_recipe_is_chosen():
    assert load_config([]).hardware == "cpu" and load_config(["hardware=gpu"]).num_envs == 16384
    assert load_config([]).num_envs == load_config(["hardware=cpu"]).num_envs == 128


def test_overrides_beat_the_recipe(tmp_path):
    config = load_config(["env=walker2d", "num_envs=32", "algo.discount=0.9", "env.healthy_z_range=[0.5, 3]"])
    assert (config.num_envs, config.algo.discount, config.env.healthy_z_range) == (32, 0.9, (0.5, 3.0))
    save_config(config, tmp_path / "config.yaml")
    assert flatten(read_config(tmp_path / "config.yaml")) == flatten(config)
    humanoid = load_config(["env.version=v4"])
    save_config(humanoid, tmp_path / "config.yaml")  # with its infinite contact_cost_range
    assert read_config(tmp_path / "config.yaml") == humanoid
