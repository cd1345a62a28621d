"""The loop: what it reports and saves, when, and how it ends."""

import dataclasses
import os
import signal
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TINY, TINY_CALL, slow_except
from jax._src import compiler
from shared_programs import shared_programs

import mjx_walk
from mjx_walk import envs
from mjx_walk import train as train_command
from mjx_walk.algos import Algorithm, make_algorithm
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.settings.config import load_config
from mjx_walk.storage import checkpoint
from mjx_walk.training import programs
from mjx_walk.training.checks import prepared
from mjx_walk.training.programs import SeedsProgram, make_init, make_step
from mjx_walk.training.trainer import Trainer
from mjx_walk.utils.errors import UserError


def test_the_same_seed_gives_the_same_run_and_another_does_not(tmp_path):
    losses = []
    for i, seed in enumerate((1, 1, 2)):
        run = [*TINY, f"run_dir={tmp_path}/{i}", f"total_steps={3 * TINY_CALL}", f"seed={seed}"]
        with shared_programs():
            losses.append([row["train/loss"] for row in mjx_walk.run(run).metrics[1:]])
    assert losses[0] == losses[1] != losses[2]


def test_nothing_is_compiled_twice():
    config = load_config([*TINY, "physics=c"])
    task = make_task(config)
    traces = 0
    step = task.step

    def counted(state, action):
        nonlocal traces
        traces += 1
        return step(state, action)

    task.step = counted
    algorithm = make_algorithm(task, config.num_envs, config.evaluation, config.algo)
    call = make_step(algorithm.collect, algorithm.learn, 2, fused=True)
    state = make_init(algorithm.init)(jax.random.PRNGKey(0))
    state, _ = call(state)
    after_first = traces
    for _ in range(3):
        state, metrics = call(state)
    assert traces == after_first and metrics["loss"].value.shape == (2,)
    assert call._call._cache_size() == 1


@pytest.mark.parametrize("seeds", slow_except(["seed=3"], ["seed=3", "seeds=[3,5]"]))
def test_each_program_is_compiled_once(seeds, tmp_path, monkeypatch):
    """What is compiled ahead is what is called, in a new run and in one that resumes."""
    compiled = []
    compile_or_get_cached = compiler.compile_or_get_cached

    def note(backend, computation, *arguments, **options):
        compiled[-1].append(str(computation.operation.attributes["sym_name"]).strip('"'))
        return compile_or_get_cached(backend, computation, *arguments, **options)

    monkeypatch.setattr(compiler, "compile_or_get_cached", note)
    for calls, resume in ((1, "false"), (3, "true")):
        compiled.append([])
        steps = f"total_steps={calls * TINY_CALL}"
        train_command.main([*TINY, seeds, f"run_dir={tmp_path / 'run'}", steps, f"resume={resume}"])
    counts = [[names.count(f"jit_{name}") for name in ("_strong_init", "collect", "learn")] for names in compiled]
    assert counts == [[1, 1, 1], [0, 1, 1]]


@pytest.mark.parametrize("dtype", slow_except(["float32"], ["float32", "bfloat16"]))
def test_a_command_builds_one_task_one_engine_and_one_algorithm(tmp_path, monkeypatch, dtype):
    """Policies are scored in float32. A second algorithm does that if the networks learn in another precision."""
    built = []

    def count(place, name):
        real = getattr(place, name)
        monkeypatch.setattr(
            place, name, lambda *arguments, **options: built.append(name) or real(*arguments, **options)
        )

    count(envs.task, "make_engine")
    count(envs.Task, "__init__")
    count(Algorithm, "__post_init__")
    overrides = ["evaluation.gymnasium_episodes=1", f"algo.network_dtype={dtype}", f"total_steps={TINY_CALL}"]
    train_command.main([*TINY, *overrides, f"run_dir={tmp_path}/run"])
    assert (tmp_path / "run" / "eval_gymnasium.json").exists()
    counts = [built.count(name) for name in ("make_engine", "__init__", "__post_init__")]
    assert counts == [1, 1, 1 if dtype == "float32" else 2]


def test_a_call_is_logged_before_the_next_begins(tmp_path, monkeypatch):
    """A row's seconds and speed are those of its own call."""
    events, step = [], programs.SeparateSteps.__call__

    def begin(self, state):
        events.append("begins")
        return step(self, state)

    monkeypatch.setattr(programs.SeparateSteps, "__call__", begin)
    overrides = [*TINY, f"run_dir={tmp_path / 'run'}", f"total_steps={3 * TINY_CALL}"]
    with shared_programs():
        mjx_walk.run(overrides, on_metrics=lambda row: events.append("is logged"))
    assert events == 3 * ["begins", "is logged"]


def test_a_reward_that_is_not_finite_warns_once(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(
        "import jax.numpy as jnp\ndef root(step):\n    return {'reward_root': jnp.sqrt(-1 - step.after.qpos[0] ** 2)}\n"
    )
    train_command.main([*TINY, f"total_steps={2 * TINY_CALL}", "env.reward_function=mine.py:root"])
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warned) == 1 and "64 of 64 steps ended their episodes without a reward" in warned[0]


def test_training_that_diverges_stops_and_keeps_what_was_saved_before(tmp_path):
    run, steps = tmp_path / "run", f"total_steps={50 * TINY_CALL}"
    arguments = [*TINY, f"run_dir={run}", "checkpoint.every_calls=1", steps]
    with pytest.raises(
        UserError, match=r"training has diverged: after 128 steps params\.policy\..* of seed 0 is not finite"
    ):
        train_command.main([*arguments, "algo.learning_rate=1e30"])
    assert 1 <= len((run / "metrics.jsonl").read_text().splitlines()) <= 3
    # PPO learns nothing from the first batch, so the checkpoint after it is finite. The second batch diverges.
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == [f"{TINY_CALL:013d}", "final"]
    policy_params = mjx_walk.load_run(run).policy_params
    assert all(np.isfinite(np.asarray(leaf, np.float64)).all() for leaf in jax.tree.leaves(policy_params))


def test_only_seeds_whose_networks_are_finite_are_saved(tmp_path, monkeypatch):
    """The second one's value network is broken from the start."""

    def broken(init):
        init = make_init(init)

        def break_second(key):
            state = init(key)
            value = jax.tree.map(lambda x: x.at[1].set(jnp.inf), state.params.value)
            return state.replace(params=state.params.replace(value=value))

        return jax.jit(break_second)

    monkeypatch.setattr(programs, "make_init", broken)
    with pytest.raises(UserError, match=r"64 steps params\.value\.\S+ of seed 5 is not finite"):
        train_command.main([*TINY, f"run_dir={tmp_path}", "seeds=[3,5]", f"total_steps={50 * TINY_CALL}"])
    assert len(list((tmp_path / "seed_3" / "checkpoints").glob("0*"))) == 1
    assert not list((tmp_path / "seed_5" / "checkpoints").iterdir())


def test_runs_keep_their_common_checkpoint_when_one_of_them_diverges(tmp_path, monkeypatch):
    """With a single checkpoint to keep, the finite run would else remove the one that both have."""
    calls = 0

    def is_finite(self, state):
        nonlocal calls
        calls += 1
        return np.array([True, calls <= 2])  # in the loop, and in the save, of each call

    monkeypatch.setattr(SeedsProgram, "is_finite", is_finite)
    arguments = [f"run_dir={tmp_path}", "checkpoint.every_calls=1", "checkpoint.max_to_keep=1", "seeds=[3,5]"]
    with pytest.raises(UserError, match="training has diverged: after 128 steps"):
        train_command.main([*TINY, *arguments, f"total_steps={50 * TINY_CALL}"])
    steps = [checkpoint.list_steps(tmp_path / f"seed_{seed}" / "checkpoints") for seed in (3, 5)]
    assert [[int(path.name) for path in own] for own in steps] == [[TINY_CALL, 2 * TINY_CALL], [TINY_CALL]]


def test_a_signal_during_the_last_save_stops_before_the_score(tmp_path, monkeypatch):
    save = Trainer._save

    def save_and_stop(self, *arguments):
        save(self, *arguments)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Trainer, "_save", save_and_stop)
    arguments = [*TINY, f"run_dir={tmp_path}", f"total_steps={TINY_CALL}", "evaluation.gymnasium_episodes=1"]
    assert train_command.main(arguments) == 128 + signal.SIGTERM
    assert not (tmp_path / "eval_gymnasium.json").exists()
    assert [int(path.name) for path in checkpoint.list_steps(tmp_path / "checkpoints")] == [TINY_CALL]


def test_an_error_in_the_loop_finishes_the_checkpoint_that_is_being_written(tmp_path, monkeypatch):
    has_failed, save = threading.Event(), checkpoint.save

    def save_later(*arguments, **options):
        assert has_failed.wait(60)
        save(*arguments, **options)

    def fail(row):
        if row["env_steps"] > TINY_CALL:
            has_failed.set()
            raise RuntimeError("a user's")

    monkeypatch.setattr(checkpoint, "save", save_later)
    settings = [*TINY, f"run_dir={tmp_path}", "checkpoint.every_calls=1"]
    with pytest.raises(RuntimeError, match="a user's"):
        mjx_walk.run(settings, on_metrics=fail)
    assert [int(path.name) for path in checkpoint.list_steps(tmp_path / "checkpoints")] == [TINY_CALL]
    with prepared([dataclasses.replace(load_config([*settings, "resume=true"]), physics="c")]):
        pass  # the lock is free


def test_resets_that_are_not_finite_reach_no_network(tmp_path):
    with pytest.raises(UserError, match=r"16 of 16 resets are not finite, or exceed 1e\+10; lower env.reset_noise"):
        train_command.main([*TINY, f"run_dir={tmp_path}/run", "env.reset_noise_scale=3e38"])
