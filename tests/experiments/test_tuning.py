"""Tuning: what is searched, what a trial is worth, which trials are taken, and studies that end, fail and resume."""

import json
import re
import signal
import sys
import time
from pathlib import Path

import pytest
import yaml
from helpers import command, command_here, finish, slow_except, start

from mjx_walk import tune
from mjx_walk.algos import ALGORITHMS, BUILT_IN_ALGORITHMS
from mjx_walk.experiments import slots
from mjx_walk.experiments.search_space import Choices, Interval, default_space, read_space
from mjx_walk.experiments.study import StudyFolder, facts_of, require_optuna
from mjx_walk.experiments.suggestions import TICKS
from mjx_walk.experiments.trial_values import value_at
from mjx_walk.experiments.tuning_report import write_page, write_tables
from mjx_walk.settings.config import flatten, load_config
from mjx_walk.utils.errors import UserError

PPO = ("env=walker2d", "algo=ppo")
SHORT = (
    *("env=inverted_pendulum", "algo=a2c", "env.max_episode_steps=40", "num_envs=8", "iterations_per_call=2"),
    *("algo.unroll_length=8", "algo.num_minibatches=2", "algo.normalizer_warmup_steps_per_env=8"),
    *("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]", "evaluation.num_envs=2"),
    *("checkpoint.every_calls=4", "algo.learning_rate_schedule=constant", "algo.learning_rate=1e-4,3e-2,1e30"),
)
"""A study whose trials take as long as their start. With the last learning rate, they end in NaN."""


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


def test_trials_of_different_lengths_are_refused():
    with pytest.raises(UserError, match="'stop_at_return=5': in a study leave it out, since trials are compared"):
        read_space([*PPO, "algo.discount=0.9,0.99", "stop_at_return=5"], "cpu")


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
    monkeypatch.setattr(slots, "count_devices", lambda: ("cpu", 1))
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
    assert (a.trial.number, b.trial.number) == (0, 1)
    assert folder.take_trial(second, space, 2, "random", "none", 0) is None
    a.trial.report(3.0, 1)
    a.release.close()  # as when its process ends
    c = folder.take_trial(second, space, 2, "random", "none", 0)
    assert (c.trial.number, c.trial.params) == (0, a.trial.params)
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
    assert page.count("<img ") == 5 and "algos=[ppo]" in page and "seeds=[4,5,6,7,8]" in page
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


def wait_for_metrics(run):
    """Wait until a run logs another row."""
    metrics, limit = run / "metrics.jsonl", time.monotonic() + 300
    before = metrics.stat().st_size if metrics.exists() else 0
    while not (metrics.exists() and metrics.stat().st_size > before) and time.monotonic() < limit:
        time.sleep(0.05)


@pytest.mark.slow
def test_a_study_of_ten_short_trials(tmp_path, monkeypatch, capfd, optuna):
    """It is stopped, killed and resumed, prunes trials, survives failures, and gives a recipe that trains."""
    arguments = [*SHORT, "total_steps=5120", "out=out", "pruner=halving", "per_device=2", "trials=10"]
    runs = [tmp_path / "out" / f"trial_{number:04d}" / "seed_0" for number in range(10)]
    for sent, code in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        process = start("tune", *arguments, cwd=tmp_path)
        wait_for_metrics(runs[0])
        process.send_signal(sent)
        assert ("Run the same command to continue" in finish(process)) == (sent == signal.SIGINT)
        assert process.returncode == code and trials_of(tmp_path / "out")[0].state.name == "RUNNING"
    done = command("tune", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    trials = trials_of(tmp_path / "out")
    ended = {trial.number: (trial.state.name, trial.params.get("algo.learning_rate")) for trial in trials}
    assert len(ended) == 10 and {state for state, _ in ended.values()} == {"COMPLETE", "PRUNED", "FAIL"}, done.stdout
    for number, (state, rate) in ended.items():
        assert (state == "FAIL") == (rate == 1e30), done.stdout
        steps = [json.loads(line)["env_steps"] for line in (runs[number] / "metrics.jsonl").read_text().splitlines()]
        assert steps == sorted(set(steps)) and (steps[-1] >= 5120 or state != "COMPLETE")
        if state != "FAIL":
            assert sorted(path.name for path in (runs[number] / "checkpoints").iterdir()) == ["best", "final"]
    assert re.search(r"trial \d+: failed: .*see out/logs/trial_\d{4}\.txt", done.stdout)
    assert "<img " in (tmp_path / "out" / "report.html").read_text()
    monkeypatch.chdir(tmp_path)
    best = StudyFolder(tmp_path / "out").open().best_params
    assert yaml.safe_load(Path("out/best.yaml").read_text())["algo"]["learning_rate"] == best["algo.learning_rate"]
    assert command_here("train", "recipe=out/best.yaml", "total_steps=1", "evaluation.gymnasium_episodes=0") == 0
    assert command_here("tune", *arguments) == 0
    assert "A study of 10 trials in out, of which 10 ended before" in capfd.readouterr().out


@pytest.mark.slow
@pytest.mark.long
def test_a_study_that_only_fails_ends(tmp_path, monkeypatch, capfd, optuna):
    """Seven environments cannot be split into minibatches."""
    monkeypatch.chdir(tmp_path)
    arguments = ["env=walker2d", "algo=ppo", "num_envs=7", "algo.discount=0.9,0.99", "out=out", "trials=20"]
    assert command_here("tune", *arguments) == 2
    printed = capfd.readouterr()
    assert "trial 2: failed: num_envs=7 times algo.num_unrolls=1 must be a multiple of" in printed.out
    assert "the first 3 trials have all failed; remove out, and correct the command" in printed.err
