"""`recipe=PATH`: a file of settings of the user's own."""

import pytest
from helpers import unregistered

from mjx_walk.algos import register_algorithm
from mjx_walk.algos.ppo import PPO, PPOConfig
from mjx_walk.experiments.planned_runs import plan
from mjx_walk.settings.config import load_config
from mjx_walk.settings.overrides import read_overrides
from mjx_walk.settings.own_hydra import own_hydra
from mjx_walk.settings.recipe_files import with_stored_recipes
from mjx_walk.utils.errors import UserError

BASE = ["env=inverted_pendulum", "hardware=cpu"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "my own").mkdir()
    monkeypatch.chdir(tmp_path / "my own")
    return tmp_path / "my own"


def loaded(recipe, *overrides):
    return load_config([*BASE, f"recipe={recipe}", *overrides])


def test_a_recipe_is_found_at_any_path(here):
    (here / "fast (1).yaml").write_text("num_envs: 24\nalgo:\n  discount: 0.5\n")
    for path in ("fast (1).yaml", "fast (1)", "./fast (1).yaml", f"{here}/fast (1).yaml", "~/my own/fast (1).yaml"):
        config = loaded(path, "algo.discount=0.75")
        assert (config.num_envs, config.algo.discount) == (24, 0.75), path
    (here / "fast (1).yaml").write_text("num_envs: 25\n")
    assert loaded("fast (1).yaml").num_envs == 25
    assert load_config([*BASE, "recipe=cpu/inverted_pendulum_ppo"]) == load_config(BASE)


def test_a_recipe_inherits_from_files_beside_it_and_from_recipes_of_this_package(here):
    (here / "deep").mkdir()
    (here / "deep" / "base.yaml").write_text("defaults:\n  - cpu/walker2d_sac\n  - _self_\nnum_envs: 7\nseed: 3\n")
    (here / "top.yaml").write_text(
        "defaults:\n  - override /env: hopper\n  - override /algo: sac\n  - deep/base\n  - _self_\nnum_envs: 9\n"
    )
    (here / "plain.yaml").write_text("defaults:\n  - /recipe/cpu/walker2d_ppo\nnum_envs: 9\n")
    config = load_config(["hardware=cpu", "recipe=top.yaml"])
    shipped = load_config(["env=walker2d", "algo=sac", "hardware=cpu"])
    assert (config.env.name, config.num_envs, config.seed) == ("hopper", 9, 3)
    assert config.algo == shipped.algo and config.total_steps == shipped.total_steps
    assert load_config(["env=walker2d", "hardware=cpu", "recipe=plain.yaml"]).num_envs == 9


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("num_envs: [1\n", "own.yaml is not valid YAML: line 2: expected ',' or ']'"),
        ("- 1\n", "own.yaml has no settings; write 'KEY: VALUE'"),
        ("", "own.yaml has no settings"),
        ("\x00", "own.yaml cannot be read: "),
        ("algo:\n  discout: 1\n", "own.yaml: unknown key 'algo.discout'; did you mean: algo.discount?"),
        ("num_envs: many\n", "own.yaml: num_envs=many: must be an integer"),
        ("num_envs: 0\n", "num_envs=0: must be at least 1"),
        ("env: ant\n", "own.yaml sets env: ant; write '- override /env: ant' below 'defaults:'"),
        (
            "env:\n  ground: steps\n",
            "own.yaml: env.ground=steps is for the command line; write the settings of env.ground",
        ),
        ("defaults: base\n", "own.yaml: its defaults are not a list; write '- NAME'"),
        ("defaults: [base]\n", "own.yaml inherits from 'base', which is neither a file beside it nor a recipe"),
        ("defaults: [own]\n", "own.yaml inherits from itself"),
    ],
)
def test_a_mistake_in_a_recipe_is_one_line(text, says, here):
    (here / "own.yaml").write_text(text)
    with pytest.raises(UserError) as error:
        loaded("own.yaml")
    assert says in str(error.value) and "\n" not in str(error.value)


def test_a_missing_recipe_is_named(here):
    for given in ("none.yaml", "./none", "~/none.yml"):
        with pytest.raises(UserError, match=r"no recipe file '/.*/none\S*'; give the path of a YAML file"):
            loaded(given)
    with pytest.raises(UserError, match="is a folder; give the path"):
        loaded("./")


def test_recipes_are_swept_and_compared(here):
    for name, value in (("a", 8), ("b, c", 16)):
        (here / f"{name}.yaml").write_text(f"num_envs: {value}\n")
    _, runs = plan([*BASE[:1], "recipe=a.yaml,'b, c.yaml'"], ["ppo"], [0, 1], None, "cpu")
    assert [run.config.num_envs for run in runs] == [8, 16, 8, 16]
    assert [load_config(list(run.overrides)).num_envs for run in runs] == [8, 16, 8, 16]
    read = read_overrides(["hardware=cpu", "recipe=a.yaml,cpu/ant_ppo"], is_sweep=True)
    with own_hydra() as store:
        swept = with_stored_recipes(read, store)[-1]
    assert swept.startswith("recipe=own_") and swept.endswith(",cpu/ant_ppo")


def test_the_hint_names_an_algorithm_with_an_underscore():
    with unregistered():
        register_algorithm("my_ppo", PPO, PPOConfig)
        with pytest.raises(UserError, match=r"does not fit env=humanoid algo=td3; add algo=my_ppo$"):
            load_config(["env=humanoid", "algo=td3", "recipe=gpu/humanoid_my_ppo"])
