"""A run from end to end: what is in its folder, and what its numbers mean."""

import json
import math
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import TINY, TINY_CHUNK, command_here
from tensorboardX.proto.event_pb2 import Event

import mjx_walk
from mjx_walk import train as train_command
from mjx_walk.algos import make_algorithm
from mjx_walk.api import make_task
from mjx_walk.envs import make_env
from mjx_walk.runs.config import load_config
from mjx_walk.training import trainer
from mjx_walk.training.trainer import make_chunk, make_init
from mjx_walk.utils.errors import UserError


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small run through the Python interface, with the rows it reported."""
    rows = []
    path = tmp_path_factory.mktemp("runs") / "run"
    overrides = [*TINY, f"run_dir={path}", f"total_steps={60 * TINY_CHUNK}", "env.max_episode_steps=40"]
    run = mjx_walk.run([*overrides, "evaluation.gymnasium_episodes=3"], on_metrics=rows.append)
    return run, rows


def test_the_folder_holds_what_it_should(finished):
    run, _ = finished
    names = {path.name for path in run.path.iterdir()}
    assert {"config.yaml", "metrics.jsonl", "checkpoints", "eval_gymnasium.json"} <= names
    for name in ("learning_curve.png", "reward_terms.png", "losses.png"):
        assert (run.path / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        assert (run.path / name).stat().st_size > 10_000
    steps = sorted(path.name for path in (run.path / "checkpoints").iterdir())
    assert steps == [f"{chunk * TINY_CHUNK:013d}" for chunk in (56, 58, 60)] + ["best"]


def test_metrics_name_everything(finished):
    run, rows = finished
    assert run.metrics == json.loads(json.dumps(rows))
    assert [row["env_steps"] for row in rows] == [TINY_CHUNK * (i + 1) for i in range(60)]
    needed = {
        "episode/return", "episode/length", "episode/reward_forward", "episode/reward_ctrl", "episode/reward_survive",
        "train/loss", "train/policy_loss", "train/value_loss", "train/kl", "train/entropy", "train/learning_rate",
        "speed/steps_per_second", "physics/nonfinite", "physics/overflow", "resets/reuse_rate", "eval/return",
        "eval/length", "wall_seconds",
    }  # fmt: skip
    assert needed <= {name for row in rows for name in row}
    for row in rows:
        if row["episode/count"]:
            terms = row["episode/reward_forward"] + row["episode/reward_ctrl"] + row["episode/reward_survive"]
            assert terms == pytest.approx(row["episode/return"], rel=1e-4, abs=1e-3)
    evaluated = [row for row in rows if "eval/return" in row]
    assert len(evaluated) > 5 and all(row["eval/env_steps"] < row["env_steps"] for row in evaluated)


def test_tensorboard_holds_the_same(finished):
    run, rows = finished
    data = next(run.path.glob("events.*")).read_bytes()
    values, at = {}, 0
    while at < len(data):  # TFRecord: length, its checksum, the event, its checksum
        size = int.from_bytes(data[at : at + 8], "little")
        event = Event.FromString(data[at + 12 : at + 12 + size])
        values |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
        at += size + 16
    for row in rows[1 :: len(rows) // 5]:
        for name in ("train/loss", "speed/steps_per_second"):
            assert values[name, row["env_steps"]] == pytest.approx(row[name], rel=1e-5)


def test_gymnasium_scores_are_those_of_a_plain_loop(finished):
    """The file's episodes, played again by the reader's own ten lines."""
    run, _ = finished
    content = json.loads((run.path / "eval_gymnasium.json").read_text())
    assert content["env"] == "Walker2d-v5" and content["seeds"] == [0, 1, 2] and "mujoco" in content["versions"]
    for seed, expected, length in zip(content["seeds"], content["returns"], content["lengths"], strict=True):
        env = gymnasium.make("Walker2d-v5", max_episode_steps=40)
        obs, _ = env.reset(seed=seed)
        total, steps, done = 0.0, 0, False
        while not done:
            obs, reward, terminated, truncated, _ = env.step(run.policy(obs))
            total, steps, done = total + reward, steps + 1, terminated or truncated
        assert (total, steps) == (pytest.approx(expected, rel=1e-6), length)
    assert content["mean"] == pytest.approx(np.mean(content["returns"]))


def test_a_loaded_policy_scores_alike_in_its_engine_and_in_gymnasium(finished):
    run, _ = finished
    loaded = mjx_walk.load_run(run.path)
    sim, real = loaded.evaluate(64, backend="sim"), loaded.evaluate(64, backend="gymnasium")
    error = math.hypot(sim.std, real.std) / 8
    assert abs(sim.mean - real.mean) < max(4 * error, 0.02 * abs(real.mean))


def test_many_episodes_are_played_in_rounds(finished, monkeypatch):
    run, _ = finished
    at_once = run.evaluate(5, seed=3)
    monkeypatch.setattr("mjx_walk.evaluation.gymnasium_scores._MAX_PARALLEL_EPISODES", 2)
    in_rounds = run.evaluate(5, seed=3)
    assert in_rounds.seeds == at_once.seeds == [3, 4, 5, 6, 7]
    assert in_rounds.returns == pytest.approx(at_once.returns, rel=1e-6)
    assert in_rounds.lengths.tolist() == at_once.lengths.tolist()


def test_eval_command(finished, capsys):
    run, _ = finished
    assert command_here("eval", f"run={run.path}", "episodes=2", "backend=sim") == 0
    assert "Walker2d-v5 on c" in capsys.readouterr().out


def test_the_same_seed_gives_the_same_run_and_another_does_not(tmp_path):
    losses = []
    for i, seed in enumerate((1, 1, 2)):
        run = [*TINY, f"run_dir={tmp_path}/{i}", f"total_steps={3 * TINY_CHUNK}", f"seed={seed}"]
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
    chunk = make_chunk(algorithm, 2, fused=True)
    state = make_init(algorithm)(jax.random.PRNGKey(0))
    state, _ = chunk(state)
    after_first = traces
    for _ in range(3):
        state, metrics = chunk(state)
    assert traces == after_first and metrics["loss"].shape == (2,)
    assert chunk._cache_size() == 1


def test_a_sweep_puts_each_job_in_its_own_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [*TINY, f"total_steps={TINY_CHUNK}"]
    assert command_here("train", "-m", "seed=0,1", *arguments) == 0
    assert len(list(tmp_path.glob("runs/sweeps/*/*/metrics.jsonl"))) == 2
    # One job of a sweep that fails does not end the others.
    assert command_here("train", "-m", "num_envs=7,8", *arguments[:1], *arguments[2:]) == 2
    printed = capsys.readouterr().err
    assert "choose num_envs a multiple of 2" in printed and "Traceback" not in printed
    assert len(list(tmp_path.glob("runs/sweeps/*/*/metrics.jsonl"))) == 3


def test_a_signal_ends_a_sweep(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trainer.Trainer, "_stop_signal", lambda self, interrupt: "SIGTERM")
    assert command_here("train", "-m", "seed=0,1", *TINY, f"total_steps={TINY_CHUNK}") == 143
    assert len(list(tmp_path.glob("runs/sweeps/*/*/config.yaml"))) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "Stopped by SIGTERM."


def test_a_model_is_found_from_another_folder_and_a_number_is_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [*TINY, f"total_steps={TINY_CHUNK}", "env.xml_file=mine.xml", "run_dir=2026_11_23"]
    theirs = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "walker2d.xml"
    (tmp_path / "mine.xml").write_text(theirs.read_text())
    assert command_here("train", *arguments) == 0
    monkeypatch.chdir("/")
    assert command_here("eval", f"run={tmp_path / '2026_11_23'}", "episodes=1") == 0
    assert "Walker2d-v5: " in capsys.readouterr().out


def test_an_asset_of_gymnasium_s_is_a_model():
    task = make_env("walker2d", physics="c", xml_file="walker2d.xml")
    env = gymnasium.make(task.gymnasium_id, **task.gymnasium_kwargs())
    assert env.unwrapped.fullpath.endswith("assets/walker2d.xml")
    np.testing.assert_array_equal(env.unwrapped.model.geom_size, task.model.geom_size)


def test_a_chunk_is_told_before_the_next_begins(tmp_path, monkeypatch):
    """So that a row's seconds, and the speed beside them, are those of its own chunk."""
    events = []

    def counted(*args, **kwargs):
        chunk = make_chunk(*args, **kwargs)

        def begin(state):
            events.append("begins")
            return chunk(state)

        return begin

    monkeypatch.setattr(trainer, "make_chunk", counted)
    overrides = [*TINY, f"run_dir={tmp_path / 'run'}", f"total_steps={3 * TINY_CHUNK}"]
    mjx_walk.run(overrides, on_metrics=lambda row: events.append("is told"))
    assert events == 3 * ["begins", "is told"]


def test_a_reward_that_is_not_finite_is_told_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(
        "import jax.numpy as jnp\ndef root(step):\n    return {'reward_root': jnp.sqrt(-1 - step.after.qpos[0] ** 2)}\n"
    )
    train_command.main([*TINY, f"total_steps={2 * TINY_CHUNK}", "env.reward_function=mine.py:root"])
    said = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(said) == 1 and "64 of 64 steps ended their episodes without a reward" in said[0]


def test_training_that_diverges_stops_and_keeps_what_was_saved_before(tmp_path):
    run, steps = tmp_path / "run", f"total_steps={50 * TINY_CHUNK}"
    arguments = [*TINY, f"run_dir={run}", "checkpoint.every_calls=1", steps]
    with pytest.raises(UserError, match=r"training has diverged: .* the policy of seed 0 is not finite"):
        train_command.main([*arguments, "algo.learning_rate=1e30"])
    assert 1 <= len((run / "metrics.jsonl").read_text().splitlines()) <= 3
    # Nothing is learned from the first batch: what was saved after it is sound. What came of the second is not.
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == [f"{TINY_CHUNK:013d}", "best"]
    policy_params = mjx_walk.load_run(run).policy_params
    assert all(np.isfinite(np.asarray(leaf, np.float64)).all() for leaf in jax.tree.leaves(policy_params))


def test_of_seeds_side_by_side_those_that_are_sound_are_saved(tmp_path, monkeypatch):
    """The second one's policy is broken from the start."""

    def broken(algorithm):
        init = make_init(algorithm)

        def break_second(key):
            state = init(key)
            policy = jax.tree.map(lambda x: x.at[1].set(jnp.nan), state.params.policy)
            return state.replace(params=state.params.replace(policy=policy))

        return break_second

    monkeypatch.setattr(trainer, "make_init", broken)
    with pytest.raises(UserError, match="the policy of seed 5 is not finite"):
        train_command.main([*TINY, f"run_dir={tmp_path}", "seeds=[3,5]", f"total_steps={50 * TINY_CHUNK}"])
    assert len(list((tmp_path / "seed_3" / "checkpoints").glob("0*"))) == 1
    assert not list((tmp_path / "seed_5" / "checkpoints").iterdir())


def test_configuration_can_be_printed(capsys):
    assert train_command.main(["--help"]) == 0
    assert "usage: python -m mjx_walk.train" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["env=walker2d", "--cfg", "job"], ["algo=sac", "--cfg", "job", "env=walker2d"]])
def test_flags_may_stand_anywhere(arguments, capsys):
    assert command_here("train", *arguments) == 0
    assert "name: walker2d" in capsys.readouterr().out
