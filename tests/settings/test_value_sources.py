"""`train … --cfg job`: the comments that say where each value comes from."""

import sys

import pytest
from helpers import unregistered
from omegaconf import OmegaConf

from mjx_walk import train as train_command
from mjx_walk.settings.config import flatten, load_config
from mjx_walk.settings.schema import leaves
from mjx_walk.utils.errors import UserError

TASK = """
from mjx_walk.envs.walker2d import Walker2d

class FastWalker(Walker2d):
    pass
"""


@pytest.fixture
def printed(capsys):
    """Prints a configuration, and returns its text after a check that it is the configuration of the command line."""

    def printed_text(*overrides):
        capsys.readouterr()
        assert train_command.main([*overrides, "--cfg", "job"]) == 0
        text = capsys.readouterr().out
        loaded = dict(leaves(OmegaConf.to_container(OmegaConf.create(text))))
        assert loaded == flatten(load_config(list(overrides)))
        assert text.count("  # ") == len(loaded)
        return text

    return printed_text


def test_of_a_task_s_recipe_and_of_the_recipe_that_it_inherits(printed):
    text = printed("hardware=gpu", "env=humanoid_standup")
    for line in (
        "  name: humanoid_standup  # command line",
        "  impact_cost_range:  # default of humanoid_standup",
        "  value_loss_coef: 0.5  # default of ppo",
        "  name: ppo  # default",
        "hardware: gpu  # command line",
        "seed: 0  # default",
        "num_envs: 16384  # recipe gpu/humanoid_standup_ppo",
        "iterations_per_call: 4  # recipe gpu/ppo",
    ):
        assert f"{line}\n" in text


@pytest.mark.parametrize("given", [[], ["recipe=cpu/ppo"], ["recipe=cpu/half_cheetah_ppo", "hardware=cpu"]])
def test_of_an_algorithm_s_recipe(given, printed):
    text = printed("env=half_cheetah", "algo=ppo", *given)
    recipe = "cpu/ppo" if given == ["recipe=cpu/ppo"] else "cpu/half_cheetah_ppo"
    assert f"# recipe {recipe}\n" in text and "  clip_epsilon: 0.2  # recipe cpu/ppo\n" in text
    assert "  num_envs: 4  # hardware cpu\n" in text
    assert ("hardware: cpu  # devices of this machine\n" in text) == ("hardware=cpu" not in given)


def test_of_a_file_of_one_s_own(printed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "base.yaml").write_text("num_envs: 7\nseed: 3\n")
    (tmp_path / "top.yaml").write_text(
        "defaults:\n  - override /env: hopper\n  - override /algo: sac\n  - cpu/walker2d_sac\n  - a b/base\n"
        "  - _self_\nnum_envs: 9\nalgo: {batch_size: 64}\nenv: {healthy_z_range: [0.5, 3.0]}\n"
    )
    text = printed("recipe=top", "hardware=cpu")
    for line in (
        f"name: hopper  # recipe {tmp_path}/top.yaml",
        f"name: sac  # recipe {tmp_path}/top.yaml",
        f"num_envs: 9  # recipe {tmp_path}/top.yaml",
        f"batch_size: 64  # recipe {tmp_path}/top.yaml",
        f"healthy_z_range:  # recipe {tmp_path}/top.yaml",
        f"seed: 3  # recipe {tmp_path}/a b/base.yaml",
        "tau: 0.01  # recipe cpu/_off_policy",
        "schedule_steps: 600000  # recipe cpu/sac: ${total_steps}",
    ):
        assert f"{line}\n" in text


def test_of_the_command_line(printed, recwarn):
    long = f"{'long ' * 40}é #a: '{{x}}'"
    text = printed(
        "seed=3",
        "evaluation={every_steps: 5}",
        "algo.entropy_cost=0.25",
        "env.healthy_z_range=[1,2]",
        f"run_dir={long}",
    )
    for start in ("seed: 3", "every_steps: 5", "entropy_coef: 0.25", "healthy_z_range:"):
        assert f"{start}  # command line\n" in text
    assert text.count("# command line\n") == 5 and "gymnasium_episodes: 100  # default\n" in text


def test_of_a_task_of_one_s_own(printed, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.py").write_text(TASK)
    with unregistered():
        text = printed("env.task=t.py:FastWalker", "hardware=gpu")
    for line in ("name: fast_walker  # command line", "frame_skip: 4  # default of fast_walker"):
        assert f"{line}\n" in text
    assert f"task: {tmp_path}/t.py:FastWalker  # command line\n" in text
    assert "num_envs: 8192  # recipe gpu/ppo\n" in text


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("seed=1,2", "seed=1,2 gives several values; give one, or write seeds=[1,2] to train a run with each"),
        ("hydra/launcher=none", "In 'hydra/config': Could not find 'hydra/launcher/none'"),
        ("hydra.none=1", "unknown key 'hydra.none'; for the settings, see: "),
        ("algo.target_kl=1", "algo.target_kl=1.0 has no effect with algo.learning_rate_schedule=linear"),
    ],
)
def test_a_mistake_is_one_line(given, says):
    with pytest.raises(UserError) as error:
        train_command.main(["--cfg", "job", given])
    assert str(error.value).startswith(says) and "\n" not in str(error.value)


def test_with_several_seeds_it_is_the_configuration_that_they_share(printed, capsys):
    text = printed("env=hopper")
    assert train_command.main(["env=hopper", "seeds=[3,4]", "--cfg", "job"]) == 0
    assert capsys.readouterr().out == text


@pytest.mark.parametrize("flags", [["--package", "evaluation"], ["--resolve"]])
def test_with_other_flags_hydra_prints(flags, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train"])
    assert train_command.main(["--cfg", "job", *flags]) == 0
    assert "num_envs: 4\n" in capsys.readouterr().out
