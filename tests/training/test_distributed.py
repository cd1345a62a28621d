"""Several devices that learn together: their means in one process, and two processes from the command to the score."""

import os
import signal
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TINY, TINY_CALL, TINY_OFF_POLICY, command, finish, saved_leaves, start, wait_for_line, wait_for_rows
from toy_tasks import ObservedReward

from mjx_walk.algos import make_algorithm
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.algos.ppo import PPO, PPOConfig
from mjx_walk.common import networks, returns
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.logs.metrics import read_rows
from mjx_walk.settings.config import load_config
from mjx_walk.storage import checkpoint
from mjx_walk.training.distributed import Processes, in_place, init_on_device, per_device
from mjx_walk.training.programs import make_init
from mjx_walk.training.restoring import restore_newest
from mjx_walk.utils.collectives import DEVICES
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import leaves_with

KEY = jax.random.PRNGKey(0)
CALL = 2 * TINY_CALL
"""Environment steps of one call on two devices."""


def test_every_device_first_evaluates_the_policy_that_acts():
    config = load_config([*TINY, "hardware=cpu"])
    algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, config.algo)
    states = [init_on_device(algorithm, index, KEY) for index in (0, 1)]
    for state in states:
        acting = algorithm.policy_params(state)
        jax.tree.map(np.testing.assert_array_equal, state.evaluation.policy_params, acting)
        jax.tree.map(np.testing.assert_array_equal, state.evaluation.best_policy_params, acting)
    assert not np.array_equal(states[0].env.env.obs, states[1].env.env.obs)


def test_evaluations_on_several_devices_are_spaced_by_the_steps_of_all():
    assert per_device(EvaluationConfig(every_steps=1001), 2).every_steps == 501
    assert per_device(EvaluationConfig(every_steps=1001), 1).every_steps == 1001


def halves(tree):
    """The first axis in two."""
    return jax.tree.map(lambda x: x.reshape((2, -1, *x.shape[1:])), tree)


def by_copy(x):
    """The second axis in two: `[T, B]` to `[2, T, B/2]`."""
    return jnp.stack(jnp.split(x, 2, axis=1))


def twice(tree):
    return jax.tree.map(lambda x: jnp.stack([x, x]), tree)


def assert_close(tree, other):
    for one, two in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-5)


def test_two_devices_learn_what_one_learns_from_both_batches():
    settings = {"num_unrolls": 1, "num_minibatches": 1, "num_epochs": 3, "entropy_coef": 0.0}
    config = PPOConfig(
        unroll_length=4,
        normalizer_warmup_steps_per_env=0,
        normalize_advantages=False,
        normalize_rewards=True,
        **settings,
    )
    algorithm = PPO(ObservedReward(), 16, EvaluationConfig(1), config)
    on_devices = PPO(ObservedReward(), 16, EvaluationConfig(1), config, axis_name=DEVICES)
    state, batch = jax.jit(algorithm.collect)(algorithm.init(KEY))
    alone, _ = jax.jit(algorithm.learn)(state, batch)
    parts = twice(batch).replace(
        transitions=halves(batch.transitions), rewards=by_copy(batch.rewards), ended=by_copy(batch.ended)
    )
    scale = twice(state.return_scale).replace(running_return=halves(state.return_scale.running_return))
    together, _ = jax.jit(jax.vmap(on_devices.learn, axis_name=DEVICES))(
        twice(state).replace(return_scale=scale), parts
    )
    for name in ("params", "optimizer", "normalizer"):
        both = getattr(together, name)
        assert_close(jax.tree.map(lambda x: x[0], both), jax.tree.map(lambda x: x[1], both))
        assert_close(jax.tree.map(lambda x: x[0], both), getattr(alone, name))
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), alone.params, state.params)
    assert max(jax.tree.leaves(moved)) > 1e-4


def test_each_device_counts_its_own_share_of_the_steps():
    part = per_device(OffPolicyConfig(schedule_steps=101, learning_starts=8, batch_size=64), 2)
    assert (part.schedule_steps, part.learning_starts, part.batch_size) == (51, 4, 64)


def test_running_statistics_are_of_all_devices():
    obs, reward = jax.random.normal(KEY, (8, 5, 3)), jax.random.normal(KEY, (20, 8))
    ended = reward > 1.0
    normalizer = networks.init_normalizer(3)
    alone = networks.update_normalizer(normalizer, obs)
    together = jax.vmap(lambda *of_device: networks.update_normalizer(*of_device, DEVICES), axis_name=DEVICES)(
        twice(normalizer), halves(obs)
    )
    assert_close(jax.tree.map(lambda x: x[1], together), alone)

    def update(scale, reward, ended):
        return returns.update_return_scale(scale, reward, ended, 0.9, DEVICES)

    full = returns.update_return_scale(returns.init_return_scale(8), reward, ended, 0.9)
    parts = jax.vmap(update, axis_name=DEVICES)(twice(returns.init_return_scale(4)), by_copy(reward), by_copy(ended))
    for name in ("count", "mean", "variance"):
        np.testing.assert_allclose(getattr(parts, name)[0], getattr(full, name), rtol=1e-4)


def test_what_a_device_gathers_stays_in_the_memory_of_what_it_had_gathered_before():
    config = PPOConfig(unroll_length=4, num_unrolls=1, num_minibatches=1)
    algorithm = PPO(ObservedReward(), 16, EvaluationConfig(1), config)
    act = in_place(algorithm.collect)
    state = make_init(algorithm.init)(KEY)
    fresh = jax.jit(algorithm.collect)(state)
    state, batch = act(state, jax.tree.map(jnp.zeros_like, fresh[1]))
    assert_close((state, batch), fresh)
    places = []
    for _ in range(3):
        jax.block_until_ready((state, batch))
        places.append([x.unsafe_buffer_pointer() for x in jax.tree.leaves((state, batch))])
        state, batch = act(state, batch)
    assert places[0] == places[1] == places[2]


def test_a_checkpoint_of_another_run_is_refused_not_passed_over(tmp_path):
    checkpoint.save(checkpoint.step_path(tmp_path, 10), {"a": np.zeros(3)}, {"env_steps": 10, "wall_seconds": 1.0})
    with pytest.raises(UserError, match="belongs to another run"):
        restore_newest(tmp_path, {"a": np.zeros(4)}, Processes())


def run(run_dir, *arguments, tiny=TINY, devices=2):
    done = command("train", *tiny, f"run_dir={run_dir}", f"devices={devices}", "checkpoint.every_calls=1", *arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def newest(run_dir):
    """The leaves of both devices' newest checkpoints."""
    found = []
    for folder in (run_dir / "checkpoints", run_dir / "checkpoints" / "device_1"):
        found.append(saved_leaves(checkpoint.list_steps(folder)[-1]))
    return found


def own_leaves(tiny):
    """Whether each leaf of the TrainState is marked as a device's own, by its path."""
    config = load_config([*tiny, "hardware=cpu"])
    algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, config.algo)
    shapes = jax.eval_shape(algorithm.init, KEY)
    return dict(zip(checkpoint._named_leaves(shapes), leaves_with(shapes, "per_device"), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("tiny", [pytest.param(TINY, marks=pytest.mark.long), (*TINY_OFF_POLICY, "algo=sac")])
def test_two_processes_learn_the_same_and_resume_exactly(tmp_path, tiny):
    scored = run(tmp_path / "full", f"total_steps={4 * CALL}", "evaluation.gymnasium_episodes=1", tiny=tiny)
    assert "2 ×" in scored.stdout and f"Final policy (step {4 * CALL} of {4 * CALL}), Walker2d-v5: " in scored.stdout
    first, second = newest(tmp_path / "full")
    is_own = own_leaves(tiny)
    for name, leaf in first.items():
        assert is_own[name] or np.array_equal(leaf, second[name]), name
    assert not np.array_equal(first["env.env.obs"], second["env.env.obs"])
    assert [row["env_steps"] for row in read_rows(tmp_path / "full" / "metrics.jsonl")] == [
        CALL,
        2 * CALL,
        3 * CALL,
        4 * CALL,
    ]
    run(tmp_path / "parted", f"total_steps={2 * CALL}", f"algo.schedule_steps={4 * CALL}", tiny=tiny)
    run(tmp_path / "parted", f"total_steps={4 * CALL}", "resume=true", tiny=tiny)
    for one, two in zip(newest(tmp_path / "full"), newest(tmp_path / "parted"), strict=True):
        for name, leaf in one.items():
            np.testing.assert_array_equal(leaf, two[name], err_msg=name)
    devices = 1 if tiny is TINY else 3
    run(tmp_path / "parted", f"total_steps={(4 + 2 * devices) * CALL}", "resume=true", tiny=tiny, devices=devices)


@pytest.mark.slow
def test_steps_that_fill_no_call_of_more_devices_are_counted(tmp_path):
    run(tmp_path, f"total_steps={3 * TINY_CALL}", devices=1)
    run(tmp_path, f"total_steps={7 * TINY_CALL}", "resume=true")
    steps = [row["env_steps"] // TINY_CALL for row in read_rows(tmp_path / "metrics.jsonl")]
    assert steps == [1, 2, 3, 5, 7]
    assert checkpoint.list_steps(tmp_path / "checkpoints")[-1].name == f"{7 * TINY_CALL:013d}"


@pytest.mark.slow
def test_a_process_that_fails_ends_the_run_which_resumes_from_its_checkpoint(tmp_path):
    settings = [*TINY, f"run_dir={tmp_path}/run", "devices=2"]
    parent = start("train", *settings, "checkpoint.every_calls=1", f"total_steps={60 * CALL}")
    wait_for_rows(parent, tmp_path / "run", 3)
    children = subprocess.run(["pgrep", "-P", str(parent.pid)], capture_output=True, text=True, check=True)
    os.kill(int(children.stdout.split()[-1]), signal.SIGKILL)
    assert "the process of device 1 failed with exit code" in finish(parent) and parent.returncode == 1
    assert not (tmp_path / "run" / "eval_gymnasium.json").exists()
    done = command("train", f"run_dir={tmp_path}/run", "devices=2", "resume=true")
    assert done.returncode == 0, done.stderr
    assert read_rows(tmp_path / "run" / "metrics.jsonl")[-1]["env_steps"] == 60 * CALL


@pytest.mark.slow
def test_a_signal_stops_all_devices_at_the_same_step(tmp_path):
    parent = start("train", *TINY, f"run_dir={tmp_path}/run", "devices=2", "total_steps=100000000")
    wait_for_rows(parent, tmp_path / "run", 1)
    parent.send_signal(signal.SIGTERM)
    assert "Stopped by SIGTERM and saved" in finish(parent) and parent.returncode == 128 + signal.SIGTERM
    checkpoints = tmp_path / "run" / "checkpoints"
    first, second = (checkpoint.list_steps(folder)[-1] for folder in (checkpoints, checkpoints / "device_1"))
    assert first.name == second.name


@pytest.mark.slow
def test_ctrl_c_while_several_devices_are_scored_says_how_to_score(tmp_path):
    long = ["evaluation.gymnasium_episodes=200", "env.terminate_when_unhealthy=false"]  # a minute or so
    parent = start("train", *TINY, f"run_dir={tmp_path}/run", "devices=2", *long, "total_steps=1")
    wait_for_line(parent, "Scoring 200 episodes")
    parent.send_signal(signal.SIGINT)
    printed = finish(parent)
    assert parent.returncode == 128 + signal.SIGINT and "Traceback" not in printed
    assert f"To score: python -m mjx_walk.eval run={tmp_path}/run" in printed
    assert checkpoint.list_steps(tmp_path / "run" / "checkpoints")
