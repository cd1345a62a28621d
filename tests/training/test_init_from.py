"""A training begins with the networks of another one, and ends at a return."""

import dataclasses
import json
import logging
import shutil

import jax
import numpy as np
import pytest
from fake_runs import fake_run
from helpers import TINY, TINY_CALL, TINY_OFF_POLICY, command_here, edit_config, train_here

import mjx_walk
from mjx_walk.algos import make_algorithm
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.experiments.planned_runs import PlannedRun
from mjx_walk.settings.config import load_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.goal import Goal
from mjx_walk.training.init_from import begin_with, read_networks
from mjx_walk.training.programs import make_init


def begun(*overrides):
    """The states of a training before its first iteration, without and with its `init_from`, as named arrays."""
    config = load_config([*overrides, "physics=c"])
    algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, config.algo)
    networks = read_networks(config, algorithm)
    assert networks is not None
    state = make_init(algorithm.init)(jax.random.PRNGKey(config.seed))
    new = begin_with(algorithm, state, networks)
    buffers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(new) if leaf.size]
    assert len(set(buffers)) == len(buffers)  # else the step could not consume them
    return checkpoint.to_host(state), checkpoint.to_host(new)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs of PPO and TD3."""
    folder = tmp_path_factory.mktemp("runs")
    train_here(folder / "ppo", "seed=7", f"total_steps={2 * TINY_CALL}")
    train_here(folder / "td3", "algo=td3", f"total_steps={4 * TINY_CALL}", tiny=TINY_OFF_POLICY)
    return folder


def saved(run):
    """The arrays of a run's newest checkpoint."""
    newest = checkpoint.list_steps(RunFolder(run).checkpoints)[-1]
    algorithm = mjx_walk.load_run(run, physics="c").algorithm
    return checkpoint.to_host(checkpoint.restore(newest, algorithm.state_shapes())[0])


@pytest.mark.parametrize(
    ("algo", "tiny", "taken", "fresh"),
    [
        ("ppo", TINY, ("params.", "normalizer.", "return_scale.mean"), ("optimizer.", "learning_rate", "iterations")),
        (
            "td3",
            (*TINY_OFF_POLICY, "algo=td3"),
            ("learner.policy.", "learner.critic.", "learner.target_", "normalizer."),
            ("learner.policy_optimizer.", "critic_updates", "replay.", "iterations"),
        ),
    ],
)
def test_networks_of_the_same_algorithm_go_on_with_new_optimizers(runs, algo, tiny, taken, fresh):
    before, after = begun(*tiny, f"init_from={runs / algo}", "env.forward_reward_weight=2", "seed=1")
    source = saved(runs / algo)
    for name, array in after.items():
        if name.startswith(taken):
            np.testing.assert_array_equal(array, source[name], err_msg=name)
        elif name.startswith(("evaluation.policy_params.1.", "evaluation.best_policy_params.1.")):
            part = "params.policy." if algo == "ppo" else "learner.policy."
            np.testing.assert_array_equal(array, source[part + name.partition("params.1.")[2]], err_msg=name)
        elif name.startswith((*fresh, "env.", "key")):
            np.testing.assert_array_equal(array, before[name], err_msg=name)
    changed = {name for name in after if not np.array_equal(after[name], before[name])}
    assert any(name.startswith(taken[0]) for name in changed) and after["iterations"] == 0


def test_another_algorithm_takes_the_best_policy(runs):
    """TD3's becomes policy and target policy of DDPG. The critic stays random."""
    before, after = begun(*TINY_OFF_POLICY, "algo=ddpg", f"init_from={runs / 'td3'}")
    run = mjx_walk.load_run(runs / "td3", physics="c")
    best = checkpoint.to_host(run.policy_params)
    for name in (name for name in best if name.startswith("1.")):
        np.testing.assert_array_equal(after[f"learner.policy.{name[2:]}"], best[name])
        np.testing.assert_array_equal(after[f"learner.target_policy.{name[2:]}"], best[name])
    for name in (name for name in after if name.startswith("learner.critic.")):
        np.testing.assert_array_equal(after[name], before[name])


def test_a_run_begins_with_a_policy_and_resumes_without_its_source(runs, tmp_path):
    """Its policy acts from the first step. Half a run and its rest equal a run without a break."""
    source = shutil.copytree(runs / "td3", tmp_path / "source")
    settings = ("algo=td3", f"init_from={source}", "seed=2", f"algo.schedule_steps={4 * TINY_CALL}")
    for name, parts in (("once", (4,)), ("twice", (2, 4))):
        for i, calls in enumerate(parts):
            if i:
                shutil.move(source, tmp_path / "moved")
            arguments = ("resume=true",) if i else settings
            tiny = () if i else TINY_OFF_POLICY
            train_here(tmp_path / name, *arguments, f"total_steps={calls * TINY_CALL}", tiny=tiny)
    once, twice = saved(tmp_path / "once"), saved(tmp_path / "twice")
    for name, array in once.items():
        np.testing.assert_array_equal(array, twice[name], err_msg=name)
    run = mjx_walk.load_run(tmp_path / "once", physics="c")
    assert run.config.init_from == str(source) and "init_from=source" in run.command
    first = mjx_walk.load_run(tmp_path / "moved", physics="c", policy="final")
    policy = run.algorithm.policy(first.policy_params)
    first_obs, first_action = once["replay.observation"][0], once["replay.action"][0]
    acted = np.asarray(policy(first_obs.astype(np.float32), jax.random.PRNGKey(0)))
    assert np.abs(acted - first_action)[0].max() < 0.2  # the first environment has the least noise


def test_several_seeds_begin_with_the_same_networks(runs, tmp_path):
    """Their first batch only measures observations."""
    train_here(tmp_path / "two", f"init_from={runs / 'ppo'}", f"total_steps={TINY_CALL}", "seeds=[3,4]")
    source = saved(runs / "ppo")
    for seed in (3, 4):
        own = saved(tmp_path / "two" / f"seed_{seed}")
        for name in (name for name in source if name.startswith("params.")):
            np.testing.assert_array_equal(own[name], source[name], err_msg=name)
        assert (own["normalizer.mean"] != source["normalizer.mean"]).any()


def test_the_code_of_the_source_is_not_needed(runs, tmp_path):
    """Neither its task nor its reward function, which may be somebody else's."""
    source = shutil.copytree(runs / "ppo", tmp_path / "source")
    edit_config(source, "  name: walker2d\n", "  name: lost_robot\n")
    edit_config(source, "  reward_function: null\n", "  reward_function: /lost/reward.py:f\n")
    _, after = begun(*TINY, f"init_from={source}")
    expected = saved(runs / "ppo")
    for name in (name for name in expected if name.startswith("params.")):
        np.testing.assert_array_equal(after[name], expected[name], err_msg=name)


def test_settings_with_which_the_same_networks_act_differently_are_named(runs, caplog):
    with caplog.at_level(logging.WARNING, "mjx_walk"):
        begun(
            *TINY, f"init_from={runs / 'ppo'}", "algo.activation=relu", "algo.observation_clip=5", "algo.discount=0.9"
        )
    assert [record.message.partition(" was trained with ")[2] for record in caplog.records] == [
        "algo.activation=tanh, and this run has relu: the same networks act differently",
        "algo.observation_clip=10.0, and this run has 5.0: the same networks act differently",
    ]


@pytest.mark.parametrize(
    ("source", "settings", "says"),
    [
        ("ppo", ("env=hopper",), "has networks of other sizes: normalizer.mean should be (11,) float32, found (17,)"),
        (
            *("ppo", ("algo.policy_hidden_layer_sizes=[16]", "algo.activation=relu")),
            "; its own networks need algo.policy_hidden_layer_sizes=[64,64] algo.activation=tanh",
        ),
        (
            *("ppo", ("init_from=zoo:walker2d-ppo", "algo.activation=swish")),
            "; its own networks need algo.policy_hidden_layer_sizes=[256,256,128]",
        ),
        ("nothing", (), "no run at"),
        ("ppo", ("init_from=",), "a path is empty"),
        ("ppo", ("init_from=zoo:walker2d-none",), "no policy 'walker2d-none' in the zoo"),
    ],
)
def test_what_does_not_fit_is_refused_before_a_folder_is_made(runs, tmp_path, capsys, source, settings, says):
    source = () if "init_from" in str(settings) else (f"init_from={runs / source}",)
    arguments = (*TINY, *settings, *source, f"run_dir={tmp_path}/run")
    assert command_here("train", *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and says in line and not (tmp_path / "run").exists()


def test_training_ends_at_a_return_and_is_complete(tmp_path, capsys):
    """Every evaluation of a walker has a return above -100."""
    arguments = ("env.max_episode_steps=8", "evaluation.gymnasium_episodes=1", f"total_steps={20 * TINY_CALL}")
    train_here(tmp_path / "run", *arguments, "stop_at_return=-100")
    rows = mjx_walk.load_run(tmp_path / "run", physics="c").metrics
    assert [("eval/return" in row) for row in rows] == [False] * (len(rows) - 1) + [True] and len(rows) < 20
    output = capsys.readouterr().out
    assert f"Training ends at step {int(rows[-1]['env_steps']):,}: every evaluation has reached -100.0" in output
    assert "Final policy (step" in output and (tmp_path / "run" / "eval_gymnasium.json").exists()
    train_here(tmp_path / "run", "resume=true", tiny=())
    assert mjx_walk.load_run(tmp_path / "run", physics="c").metrics == rows
    assert "The run has already reached stop_at_return=-100.0; to continue" in capsys.readouterr().out
    train_here(tmp_path / "run", "resume=true", "stop_at_return=1_000_000", tiny=())
    assert mjx_walk.load_run(tmp_path / "run", physics="c").metrics[-1]["env_steps"] == 20 * TINY_CALL


def log_of(folder, *returns):
    """A run whose rows have these evaluations, of which None is missing."""
    fake_run(folder, [*TINY, "algo=ppo", "total_steps=5_000_000", "stop_at_return=10"], [0.0] * len(returns))
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    rows = [row | {"eval/return": value} for row, value in zip(rows, returns, strict=True)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return RunFolder(folder)


def test_a_goal_that_one_of_two_seeds_has_reached_before_a_resume_counts(tmp_path):
    folders = [log_of(tmp_path / "a", 1.0, 12.0, 3.0), log_of(tmp_path / "b", 1.0, 2.0, 11.0)]
    for steps, later, is_reached in ((2e6, 9.0, False), (2e6, 10.0, True), (3e6, 0.0, True)):
        goal = Goal(10.0, 2)
        goal.recall(folders, int(steps))
        goal.take([{"env_steps": steps}, {"env_steps": steps, "eval/return": later}], is_main=True)
        assert goal.is_reached == is_reached
    goal = Goal(None, 2)
    goal.recall(folders, 3_000_000)
    assert not goal.is_reached


def test_a_comparison_takes_a_run_that_reached_its_goal_as_finished(tmp_path):
    for name, returns, is_finished in (("reached", (None, 11.0), True), ("running", (None, 9.0), False)):
        folder = log_of(tmp_path / name, *returns)
        overrides = [*TINY, "algo=ppo", "total_steps=5_000_000", "stop_at_return=10", f"run_dir={folder.path}"]
        assert PlannedRun("ppo", (), load_config(overrides)).is_finished == is_finished


def test_random_steps_are_those_before_learning_unless_given():
    config = load_config([*TINY_OFF_POLICY, "algo=sac", "physics=c"])
    for given, expected in ((None, 64), (0, 0), (16, 16)):
        algo = dataclasses.replace(config.algo, random_steps=given)
        algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, algo)
        assert algorithm.num_random_steps == expected
