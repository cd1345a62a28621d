"""Configurations: what is saved is what is read, and mistakes cost one line."""

import dataclasses
import re
import shlex
import sys

import pytest
import yaml
from helpers import CLONE, used_settings

from mjx_walk import train as train_command
from mjx_walk.algos import ALGORITHMS
from mjx_walk.api import make_task, resolve
from mjx_walk.experiments import planned_runs
from mjx_walk.settings.config import flatten, load_config, training_command
from mjx_walk.settings.saved_config import read_config, save_config
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import describe


def test_without_an_accelerator_the_small_recipe_is_chosen():
    assert load_config([]).hardware == "cpu" and load_config(["hardware=gpu"]).num_envs == 8192
    assert load_config([]).num_envs == load_config(["hardware=cpu"]).num_envs == 128


def test_the_command_with_the_settings_of_stable_baselines3_leaves_none_to_a_recipe():
    page = (CLONE / "docs" / "from_stable_baselines3.md").read_text()
    _, _, _, *words = shlex.split(next(line for line in page.splitlines() if line.startswith("python -m")))
    algos = [load_config([f"hardware={hardware}", *words]).algo for hardware in ("cpu", "gpu")]
    schedules = {"schedule_steps": 1, "entropy_schedule": "constant"}  # without effect: nothing falls
    assert dataclasses.replace(algos[0], **schedules) == dataclasses.replace(algos[1], **schedules)
    assert not algos[0].normalize_rewards and algos[0].learning_rate_schedule == "constant"


def test_overrides_beat_the_recipe(tmp_path):
    config = load_config(["env=walker2d", "num_envs=32", "algo.discount=0.9", "env.healthy_z_range=[0.5, 3]"])
    assert (config.num_envs, config.algo.discount, config.env.healthy_z_range) == (32, 0.9, (0.5, 3.0))
    save_config(config, tmp_path / "config.yaml")
    assert flatten(read_config(tmp_path / "config.yaml")) == flatten(config)
    humanoid = load_config(["env.version=v4"])
    save_config(humanoid, tmp_path / "config.yaml")  # with its infinite contact_cost_range
    assert read_config(tmp_path / "config.yaml") == humanoid


@pytest.mark.parametrize(
    "line",
    [
        *("_target_: os.system", "defaults: [train]", "hydra: {run: {dir: /tmp/x}}", "seed: {a: 1}", "seed: [1]"),
        *("env: {name: walker2d, _target_: os.system}", "env: {name: walker2d, shaping: 7}", "num_envs: 1e99"),
        *("env: {name: walker2d, shaping: {deep: {er: 1}}}", "algo: {name: ppo, policy_hidden_layer_sizes: x}"),
        *("algo: {name: __class__}", "env: null", "evaluation: null", "total_steps: .nan", "resume: maybe"),
        *("checkpoint: {every_calls: 0}", "matmul_precision: high", "env: {name: walker2d, healthy_z_range: [a]}"),
    ],
)
def test_any_line_of_a_strangers_configuration_costs_one_line(tmp_path, line):
    save_config(load_config(["env=walker2d", "algo=ppo", "hardware=cpu"]), tmp_path / "config.yaml")
    saved = yaml.safe_load((tmp_path / "config.yaml").read_text())
    for key, value in yaml.safe_load(line).items():
        saved[key] = saved[key] | value if isinstance(value, dict) and key in ("env", "algo", "checkpoint") else value
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(saved))
    with pytest.raises(UserError) as error:
        make_task(read_config(tmp_path / "config.yaml"))
    assert "\n" not in str(error.value)


FORMER = ["algo.entropy_cost=0.25", "updates_per_chunk=3", "checkpoint.every_chunks=7"]
PRESENT = {"algo.entropy_coef": 0.25, "iterations_per_call": 3, "checkpoint.every_calls": 7}


def renamings(warned):
    return [str(warning.message) for warning in warned if " is now " in str(warning.message)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"run_dir: ${oc.env:HOME}\n", r"line 1 of .* contains '\$\{', which no saved configuration does"),
        (b'run_dir: "\\x24{oc.env:HOME}"\n', r"line 1 of .* contains '\$\{'"),
        (b'run_dir: "$\\u007boc.env:HOME}"\n', r"line 1 of .* contains '\$\{'"),
        (b'run_dir: "$\\\n  {oc.env:HOME}"\n', r"line 1 of .* contains '\$\{'"),
        (b"\xff\xfe", "is not a configuration of this version"),
        (b"run_dir: [\n", "is not a configuration of this version"),
        (b"seed: 1\n", "is not a configuration of this version"),
        (b"- 1\n", "is not a configuration of this version"),
        (b"just text\n", "is not a configuration of this version"),
        (b"", "is not a configuration of this version"),
        (b"env:\n  name: [walker2d]\nalgo:\n  name: ppo\n", "is not a configuration of this version"),
        (b"[" * 1500, "is not a configuration of this version"),
        (b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "line 1 of .*config.yaml has an anchor"),
        (b"a: *a\n", "line 1 of .*config.yaml has an alias"),
        (b"seed: 1\nrun_dir: !!python/object/apply:os.system ['touch ran']\n", "line 2 of .*config.yaml has a tag"),
        (b"run_dir: !!python/object/apply:pathlib.PosixPath [x]\n", "has a tag"),
        (b'run_dir: "a\\e[2Jb"\n', "line 1 of .*config.yaml has characters that cannot be printed"),
        ("run_dir: a\u202eb\n".encode(), "has characters that cannot be printed"),
        (b"#" * 100_001, "is larger than 100,000 bytes"),
    ],
)
def test_a_strangers_configuration_is_refused_in_one_line(tmp_path, text, says):
    (tmp_path / "config.yaml").write_bytes(text)
    with pytest.raises(UserError, match=says) as error:
        read_config(tmp_path / "config.yaml")
    assert "\n" not in str(error.value)


def test_a_former_name_works_on_a_command_line_and_warns_once(recwarn):
    config = flatten(resolve(FORMER))
    assert PRESENT.items() <= config.items()
    assert len(renamings(recwarn)) == 3
    assert renamings(recwarn)[0] == "algo.entropy_cost is now algo.entropy_coef; the former name still works"


def test_a_former_name_works_in_a_sweep(recwarn, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    trained = []
    monkeypatch.setattr(train_command, "train", lambda configs: (trained.append(configs[0]), None))
    monkeypatch.setattr(sys, "argv", ["train"])
    train_command.main(["-m", "algo.entropy_cost=0,0.25", "updates_per_chunk=3"])
    assert [config.algo.entropy_coef for config in trained] == [0, 0.25]
    assert {config.iterations_per_call for config in trained} == {3} and len(renamings(recwarn)) == 2


def test_a_former_name_works_in_a_comparison(recwarn, tmp_path):
    _, planned = planned_runs.plan(["algo.entropy_cost=0,0.25"], ["ppo"], [0], str(tmp_path), "cpu")
    assert [run.variant for run in planned] == ["ppo_entropy_coef-0", "ppo_entropy_coef-0.25"]
    assert len(renamings(recwarn)) == 1


def test_former_names_in_a_saved_configuration_load_silently_and_a_resumed_run_may_be_given_one(recwarn, tmp_path):
    config = load_config(["algo.entropy_coef=0.25", "iterations_per_call=3", "checkpoint.every_calls=7"])
    save_config(config, tmp_path / "config.yaml")
    saved = (tmp_path / "config.yaml").read_text()
    for old, new in (
        ("entropy_cost", "entropy_coef"),
        ("updates_per_chunk", "iterations_per_call"),
        ("every_chunks", "every_calls"),
    ):
        assert f"{new}:" in saved
        saved = saved.replace(f"{new}:", f"{old}:")
    (tmp_path / "config.yaml").write_text(saved)
    assert read_config(tmp_path / "config.yaml") == config and not renamings(recwarn)
    resumed = resolve([f"run_dir={tmp_path}", "resume=true", "algo.entropy_cost=0.5", "algo=ppo"])
    assert resumed.algo.entropy_coef == 0.5 and len(renamings(recwarn)) == 1
    resumed = resolve([f"run_dir={tmp_path}", "resume=true", "algo.entropy_cost=0.75"])
    assert resumed.algo.entropy_coef == 0.75 and resumed.iterations_per_call == 3


def test_a_given_setting_without_effect_is_refused_unless_a_run_is_resumed(tmp_path, monkeypatch):
    given, constant, linear = (
        "algo.schedule_steps=7",
        "algo.learning_rate_schedule=constant",
        "algo.learning_rate_schedule=linear",
    )
    message = (
        "algo.schedule_steps=7 has no effect with algo.learning_rate_schedule=constant and "
        "algo.entropy_schedule=constant; change that, or leave it out"
    )
    with pytest.raises(UserError, match=message):
        resolve([given, constant])
    assert resolve([given, linear]).algo.schedule_steps == 7
    config = load_config([constant])  # a recipe sets it, which is no mistake
    assert "algo.schedule_steps" not in training_command(dataclasses.replace(config, seed=1))
    config.algo.schedule_steps = 7
    save_config(config, tmp_path / "config.yaml")
    for further in ([], [given], ["env=humanoid", "algo=ppo", given, constant]):
        assert resolve([f"run_dir={tmp_path}", "resume=true", *further]).algo.schedule_steps == 7


def test_schedules_end_with_a_new_run_and_stay_when_it_is_resumed(tmp_path):
    config = load_config(["env=walker2d", "algo=csac", "hardware=gpu", "total_steps=5000"])
    assert config.algo.schedule_steps == 5000
    assert training_command(config) == "python -m mjx_walk.train env=walker2d algo=csac total_steps=5000"
    part = load_config(["env=walker2d", "algo=csac", "hardware=gpu", "total_steps=5000", "algo.schedule_steps=8000"])
    assert training_command(part).endswith("algo=csac algo.schedule_steps=8000 total_steps=5000")
    save_config(config, tmp_path / "config.yaml")
    resume = [f"run_dir={tmp_path}", "resume=true", "total_steps=9000"]
    assert resolve(resume).algo.schedule_steps == 5000
    assert resolve([*resume, "algo.schedule_steps=9000"]).algo.schedule_steps == 9000


def test_a_shell_and_hydra_read_the_values_of_a_training_command(tmp_path):
    """Without a value, lists, truth values, and a file whose name has a space."""
    task = tmp_path / "my task.xml"
    given = ["env=humanoid", "algo=csac", "hardware=cpu", "algo.target_entropy=0.5", "algo.final_target_entropy=null"]
    given += ["algo.normalize_rewards=false", "algo.critic_hidden_layer_sizes=[64,32]", f"env.xml_file={task}"]
    config = load_config(given)
    config.algo.final_target_entropy, config.algo.noise_repeat = None, None
    words = shlex.split(training_command(config))
    assert words[:5] == ["python", "-m", "mjx_walk.train", "env=humanoid", "algo=csac"]
    assert {f"env.xml_file={task}", "algo.critic_hidden_layer_sizes=[64,32]"} < {*words}
    assert flatten(load_config(["hardware=cpu", *words[3:]])) == flatten(config)


def test_a_job_of_a_sweep_whose_setting_has_no_effect_is_refused(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    trained = []
    monkeypatch.setattr(train_command, "train", lambda configs: (trained.append(configs[0]), None))
    monkeypatch.setattr(sys, "argv", ["train"])
    with pytest.raises(UserError, match="has no effect with"):
        train_command.main(["-m", "algo.schedule_steps=7", "algo.learning_rate_schedule=linear,constant"])
    assert [config.algo.learning_rate_schedule for config in trained] == ["linear"]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_help_lists_an_algorithm_s_settings_and_where_they_have_an_effect(algo, capsys):
    train_command.main([f"algo={algo}", "--help"])
    text = capsys.readouterr().out
    for line in describe(ALGORITHMS[algo][1], "algo."):
        assert line in text
    assert "algo.name=" not in text
    assert "only with learning_rate_schedule other than constant or " in text
    assert ("algo.gae_lambda" in text) == ("gae_lambda" in used_settings(algo))


WITHOUT_EFFECT = {
    "algo=ppo algo.entropy_coef=0 algo.entropy_schedule=linear": "algo.entropy_coef=0.0",
    "algo=ppo algo.target_kl=0.1": "algo.learning_rate_schedule=linear",
    "algo=ppo algo.state_dependent_std=true": "algo.distribution=tanh_normal",
    "algo=ppo algo.init_noise_std=0.1": "algo.distribution=tanh_normal",
    "algo=a2c algo.init_noise_std=0.1 algo.state_dependent_std=true": "algo.state_dependent_std=true",
    "algo=a2c algo.mean_bound_coef=2 algo.distribution=tanh_normal": "algo.distribution=tanh_normal",
    "algo=a2c algo.ou_noise_theta=0.1": "algo.ou_noise_std=0.0",
    "algo=td3 algo.target_noise_clip=0.1 algo.target_noise=0": "algo.target_noise=0.0",
    "algo=sac algo.normalized_return_max=3": "algo.normalize_rewards=false",
    "algo=sac algo.learning_rate_schedule=constant algo.schedule_steps=9": "algo.final_target_entropy=null",
}


@pytest.mark.parametrize(("overrides", "reason"), WITHOUT_EFFECT.items())
def test_a_given_setting_without_effect_names_what_disables_it(overrides, reason):
    with pytest.raises(UserError, match=rf"has no effect with .*{re.escape(reason)}; change that, or leave it out"):
        load_config(overrides.split())


def test_settings_that_have_an_effect_are_not_refused():
    load_config(["algo=csac", "algo.normalize_rewards=false", "algo.normalized_return_max=3"])
    load_config(
        ["algo=sac", "algo.learning_rate_schedule=constant", "algo.final_discount=0.9", "algo.schedule_steps=9"]
    )
    load_config(["algo=ppo", "algo.distribution=normal", "algo.init_noise_std=0.1"])


def test_reinforce_refuses_the_settings_of_a_value_network():
    with pytest.raises(UserError, match=r"algo\.gae_lambda=0\.9 has no effect here; leave it out"):
        load_config(["algo=reinforce", "algo.gae_lambda=0.9"])
