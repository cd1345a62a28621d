"""Tuning: what is searched, what a trial is worth, which trials are taken, and studies that end, fail and resume."""

import json
import os
import signal
import sys
import time

import pytest
import yaml
from helpers import command, command_here, finish, slow_except, start

from mjx_walk import tune
from mjx_walk.algos import ALGORITHMS, BUILT_IN_ALGORITHMS
from mjx_walk.experiments.search_space import Choices, Interval, default_space, read_space
from mjx_walk.experiments.study import TICKS, StudyFolder, facts_of, require_optuna
from mjx_walk.experiments.trials import value_at
from mjx_walk.experiments.tuning_report import write_page, write_tables
from mjx_walk.settings.config import flatten, load_config
from mjx_walk.utils.errors import UserError

PPO = ("env=walker2d", "algo=ppo")
SHORT = (
    *("env=inverted_pendulum", "algo=a2c", "env.max_episode_steps=40", "num_envs=8", "iterations_per_call=2"),
    *("algo.unroll_length=8", "algo.num_minibatches=2", "algo.normalizer_warmup_steps_per_env=8"),
    *("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]", "evaluation.num_envs=2"),
    *("checkpoint.every_calls=4", "algo.learning_rate=tag(log,interval(1e-4,1e-1))", "algo.discount=0.9,0.99"),
)
"""A study whose trials take as long as their start."""


@pytest.fixture
def optuna():
    """Optuna, which is installed for campaigns only."""
    return pytest.importorskip("optuna", reason="pip install optuna")


def test_several_values_are_searched_and_one_is_kept():
    overrides = [
        *(*PPO, "total_steps=1e5", "algo.gae_lambda=0.9", "algo.num_epochs=interval(2,10)"),
        *("algo.learning_rate=tag(log,interval(1e-5,1e-2))", "algo.discount=0.9,0.99", "num_envs=range(32,97,32)"),
        *("algo.policy_hidden_layer_sizes=[32,32],[64,64]", "algo.max_value_grad_norm=null,0.5"),
    ]
    space = read_space(overrides, "cpu")
    assert space.ranges == {
        "algo.num_epochs": Interval(2, 10, is_log=False, is_int=True),
        "algo.learning_rate": Interval(1e-5, 1e-2, is_log=True, is_int=False),
        "algo.discount": Choices((0.9, 0.99), (0.9, 0.99)),
        "num_envs": Choices((32, 64, 96), (32, 64, 96)),
        "algo.policy_hidden_layer_sizes": Choices(("[32,32]", "[64,64]"), ([32, 32], [64, 64])),
        "algo.max_value_grad_norm": Choices(("null", 0.5), (None, 0.5)),
    }
    assert (space.recipe.total_steps, space.recipe.algo.gae_lambda) == (100_000, 0.9)
    assert space.recipe.evaluation.gymnasium_episodes == 0
    assert space.recipe_values == {
        "algo.num_epochs": 10,
        "algo.learning_rate": 3e-4,
        "algo.discount": 0.99,
        "num_envs": 64,
        "algo.policy_hidden_layer_sizes": "[64,64]",
        "algo.max_value_grad_norm": "null",
    }
    again = read_space([*PPO, *(f"{key}={values}" for key, values in space.ranges.items())], "cpu")
    assert again.ranges == space.ranges


def test_values_of_a_trial_become_its_settings():
    space = read_space([*PPO, "algo.activation=tanh,swish", "algo.value_hidden_layer_sizes=[8],[16]"], "cpu")
    values = {"algo.activation": "swish", "algo.value_hidden_layer_sizes": "[16]"}
    config = load_config(space.overrides(values))
    assert config.algo.activation == "swish" and list(config.algo.value_hidden_layer_sizes) == [16]
    assert load_config(space.overrides({})) == space.recipe


@pytest.mark.parametrize("algo", slow_except(["ppo", "csac"], BUILT_IN_ALGORITHMS))
def test_default_ranges_are_valid_and_hold_the_recipe(algo):
    space = read_space(["env=walker2d", f"algo={algo}"], "cpu")
    assert len(space.ranges) >= 4 and space.recipe_values.keys() == space.ranges.keys()
    assert space.ranges.keys() == default_space(space.recipe).keys()


def test_every_algorithm_has_default_ranges_of_its_own_settings():
    for name, (_, config) in ALGORITHMS.items():
        with_search = [field.name for field in config.__dataclass_fields__.values() if "search" in field.metadata]
        assert with_search, name


def test_fixed_settings_leave_the_default_ranges():
    space = read_space([*PPO, "algo.clip_epsilon=0.1", "algo.discount=0.9,0.99"], "cpu", with_defaults=True)
    assert "algo.clip_epsilon" not in space.ranges and str(space.ranges["algo.discount"]) == "0.9,0.99"
    assert "algo.gae_lambda" in space.ranges and "algo.target_kl" not in space.ranges  # which has no effect


def rows(*evaluations, total=100):
    """Log rows, a tenth of the training each, with these evaluations, of which None is missing."""
    found = [{"env_steps": total // 10 * i} for i in range(1, 11)]
    for row, value in zip(found, evaluations, strict=False):
        row |= {} if value is None else {"eval/return": value, "eval/env_steps": row["env_steps"] - 5}
    return found


def test_a_value_is_the_mean_of_the_last_three_evaluations_and_of_seeds():
    first, second = rows(1.0, 2.0, None, 6.0, 7.0), rows(10.0)
    assert value_at([first], 100) == pytest.approx(5.0) and value_at([first], 100, 4) == pytest.approx(1.5)
    assert value_at([first], 100, 3) == pytest.approx(1.5)  # the row that passes 15%
    assert value_at([first, second], 100) == pytest.approx(7.5)
    assert value_at([first, rows()], 100) is None and value_at([first[:5]], 100) is None
    assert value_at([first[:5]], 100, TICKS // 2) == pytest.approx(5.0)
    first[0]["eval/env_steps"] = 0  # of the untrained policy
    assert value_at([first], 100, 2) is None


def test_without_optuna_one_line_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.setattr(tune, "count_devices", lambda: ("cpu", 1))
    for arguments in ([*PPO, "algo.discount=0.9,0.99"], ["draw=true", "out=."]):
        with pytest.raises(UserError, match=r"^Optuna is missing: pip install 'mjx-walk\[tune\]'$"):
            tune.main(arguments)
    assert list(tmp_path.iterdir()) == []


def simulate(folder, study, space, num_trials, value, seed=0):
    """Trials without a training."""
    numbers = []
    while taken := folder.take_trial(study, space, num_trials, "tpe", "none", seed):
        study.tell(taken.trial, value(taken.trial.params))
        taken.release.close()
        numbers.append(taken.trial.number)
    return numbers


@pytest.mark.slow
def test_a_study_continues_without_repeating_itself(tmp_path, optuna):
    require_optuna()
    space = read_space([*PPO, "algo.learning_rate=tag(log,interval(1e-5,1e-2))", "algo.discount=0.9,0.99"], "cpu")
    folder = StudyFolder(tmp_path / "out")
    study = folder.create_or_open(facts_of(space, [0]))
    assert simulate(folder, study, space, 6, lambda values: values["algo.learning_rate"]) == list(range(6))
    assert study.trials[0].params == space.recipe_values
    again = folder.create_or_open(facts_of(space, [0]))
    assert simulate(folder, again, space, 12, lambda values: values["algo.learning_rate"]) == list(range(6, 12))
    rates = [trial.params["algo.learning_rate"] for trial in again.trials]
    assert len(set(rates)) == 12
    other = StudyFolder(tmp_path / "other")
    repeated = other.create_or_open(facts_of(space, [0]))
    simulate(other, repeated, space, 12, lambda values: values["algo.learning_rate"])
    assert [trial.params["algo.learning_rate"] for trial in repeated.trials] == rates  # of the same seed


@pytest.mark.slow
def test_processes_share_trials_and_take_over_what_another_has_left(tmp_path, optuna):
    require_optuna()
    space = read_space([*PPO, "algo.discount=0.9,0.99"], "cpu")
    folder = StudyFolder(tmp_path / "out")
    first, second = (folder.create_or_open(facts_of(space, [0])) for _ in range(2))
    a = folder.take_trial(first, space, 2, "random", "none", 0)
    b = folder.take_trial(second, space, 2, "random", "none", 0)
    assert (a.trial.number, b.trial.number, a.is_new, b.is_new) == (0, 1, True, True)
    assert folder.take_trial(second, space, 2, "random", "none", 0) is None
    a.trial.report(3.0, 1)
    a.release.close()  # as when its process ends
    c = folder.take_trial(second, space, 2, "random", "none", 0)
    assert (c.trial.number, c.is_new, c.trial.params) == (0, False, a.trial.params)
    second.tell(c.trial, 1.0)
    assert first.trials[0].intermediate_values == {1: 3.0} and first.best_value == 1.0


@pytest.mark.slow
def test_a_folder_with_another_study_is_left_alone(tmp_path, optuna):
    require_optuna()
    space = read_space([*PPO, "algo.discount=0.9,0.99"], "cpu")
    folder = StudyFolder(tmp_path / "out")
    folder.create_or_open(facts_of(space, [0]))
    for changed, named in (
        ((*PPO, "algo.discount=0.9,0.98"), "search algo.discount"),
        ((*PPO, "algo.discount=0.9,0.99", "num_envs=32"), "num_envs \\(was 64, now 32"),
    ):
        with pytest.raises(UserError, match=f"holds a study with other settings \\({named}.*choose another out=DIR"):
            folder.create_or_open(facts_of(read_space([*changed], "cpu"), [0]))
    with pytest.raises(UserError, match=r"seeds \(was \[0\], now \[1\]\)"):
        folder.create_or_open(facts_of(space, [1]))
    with pytest.raises(UserError, match="no study in"):
        StudyFolder(tmp_path).open()
    for content in ("hello\nworld\n", "{}\n{}\n", folder.storage.read_text()[:-20] + "\n{}\n", "[1]\n"):
        (tmp_path / "study.log").write_text(content)
        with pytest.raises(UserError, match="is not the log of a study"):
            StudyFolder(tmp_path).open()
    (tmp_path / "study.log").unlink()
    (tmp_path / "study.log").symlink_to(folder.storage)
    with pytest.raises(UserError, match="is a symbolic link"):
        StudyFolder(tmp_path).open()


@pytest.mark.slow
def test_the_report_ranks_trials_and_the_best_is_a_recipe(tmp_path, optuna):
    require_optuna()
    overrides = [*PPO, "num_envs=32", "algo.discount=0.9,0.99", "algo.activation=tanh,swish", "algo.num_epochs=2,5"]
    space = read_space(overrides, "cpu")
    folder = StudyFolder(tmp_path)
    study = folder.create_or_open(facts_of(space, [0, 3]))
    simulate(folder, study, space, 12, lambda values: 10 * values.get("algo.num_epochs", 0) + values["algo.discount"])
    write_tables(folder, study)
    page = write_page(folder, study).read_text()
    assert page.count("<img ") == 5 - 1 and "algos=[ppo]" in page and "seeds=[4,5,6,7,8]" in page  # none was pruned
    config = load_config([f"recipe={tmp_path}/best.yaml"])
    assert (config.env.name, config.algo.name, config.num_envs) == ("walker2d", "ppo", 32)
    assert (config.algo.num_epochs, config.algo.discount) == (5, 0.99)
    assert config.algo.activation == study.best_trial.params["algo.activation"]
    differing = {k for k, v in flatten(config).items() if v != flatten(space.recipe)[k]}
    assert differing <= {*space.ranges, "evaluation.gymnasium_episodes"}
    lines = (tmp_path / "trials.csv").read_text().splitlines()
    assert len(lines) == 13 and lines[0].startswith("trial,state,value,algo.discount,algo.activation,algo.num_epochs")
    assert ",10," in lines[1]  # the recipe's own value, which the range does not hold


def trials_of(folder):
    return StudyFolder(folder).open().trials


@pytest.mark.slow
def test_a_study_of_ten_short_trials(tmp_path, monkeypatch, capfd, optuna):
    """It is killed, resumes, prunes trials, and gives a recipe that trains."""
    arguments = [*SHORT, "total_steps=5120", "out=out", "pruner=halving", "per_device=2"]
    process = start("tune", *arguments, "trials=10", cwd=tmp_path)
    metrics = tmp_path / "out" / "trial_0001" / "seed_0" / "metrics.jsonl"
    limit = time.monotonic() + 120
    while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < limit:
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    assert "2 trials" not in finish(process) and process.returncode == -signal.SIGKILL
    done = command("tune", *arguments, "trials=10", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    monkeypatch.chdir(tmp_path)
    states = [trial.state.name for trial in trials_of("out")]
    assert len(states) == 10 and set(states) == {"COMPLETE", "PRUNED"} and states[0] == "COMPLETE", done.stdout
    assert f"10 trials: {states.count('COMPLETE')} complete, {states.count('PRUNED')} pruned" in done.stdout
    for number, state in enumerate(states):
        run = tmp_path / "out" / f"trial_{number:04d}" / "seed_0"
        steps = [json.loads(line)["env_steps"] for line in (run / "metrics.jsonl").read_text().splitlines()]
        assert steps == sorted(set(steps)) and (steps[-1] >= 5120 or state == "PRUNED")
        assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["best", "final"]
    assert "<img " in (tmp_path / "out" / "report.html").read_text()
    best = yaml.safe_load((tmp_path / "out" / "best.yaml").read_text())
    assert best["algo"]["learning_rate"] == StudyFolder(tmp_path / "out").open().best_params["algo.learning_rate"]
    assert command_here("train", "recipe=out/best.yaml", "total_steps=1", "evaluation.gymnasium_episodes=0") == 0
    before = [trial.value for trial in trials_of("out")]
    assert command_here("tune", *arguments, "trials=10") == 0
    assert "10 trials in out, 10 of them have ended already" in capfd.readouterr().out
    assert [trial.value for trial in trials_of("out")] == before


@pytest.mark.slow
def test_a_trial_that_fails_does_not_end_the_study(tmp_path, monkeypatch, capfd, optuna):
    """Seven environments cannot be split into minibatches."""
    monkeypatch.chdir(tmp_path)
    arguments = [one for one in SHORT if not one.startswith(("num_envs=", "algo.learning_rate=", "algo.discount="))]
    assert command_here("tune", *arguments, "num_envs=8,7", "trials=3", "total_steps=640", "out=out", "seed=1") == 0
    printed = capfd.readouterr().out
    found = {trial.params["num_envs"]: trial for trial in trials_of("out")}
    assert found[7].state.name == "FAIL" and found[8].state.name == "COMPLETE", printed
    assert "must be a multiple of algo.num_minibatches=2" in found[7].user_attrs["reason"]
    assert "failed: num_envs=7 times algo.num_unrolls" in printed


@pytest.mark.slow
def test_a_study_that_only_fails_ends(tmp_path, monkeypatch, capfd, optuna):
    monkeypatch.chdir(tmp_path)
    arguments = [*SHORT, "num_envs=7", "total_steps=640", "out=out", "trials=20"]
    assert command_here("tune", *(one for one in arguments if one != "num_envs=8")) == 2
    assert "the first 3 trials have all failed; remove out, and correct the command" in capfd.readouterr().err


@pytest.mark.slow
def test_ctrl_c_saves_the_trials(tmp_path, monkeypatch, optuna):
    arguments = [*SHORT, "total_steps=1000000", "out=out", "trials=1"]
    process = start("tune", *arguments, cwd=tmp_path)
    run = tmp_path / "out" / "trial_0000" / "seed_0"
    limit = time.monotonic() + 120
    while not (run / "metrics.jsonl").exists() and time.monotonic() < limit:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    assert "Stopped by SIGINT. Run the same command to continue." in finish(process) and process.returncode == 130
    assert [trial.state.name for trial in trials_of(tmp_path / "out")] == ["RUNNING"]
    assert any(path.name.isdigit() for path in (run / "checkpoints").iterdir())
