"""Which policies a run keeps and scores."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_walk.algos import make_algorithm
from mjx_walk.evaluation.saved_policies import SavedPolicy, choose_policy, load_policy, make_task
from mjx_walk.settings.config import load_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder, open_existing
from mjx_walk.storage.scores import Scores, read_scores
from mjx_walk.training import scoring
from mjx_walk.training.distributed import Processes
from mjx_walk.training.recorder import Recorder
from mjx_walk.training.restoring import restore_newest
from mjx_walk.utils.errors import UserError

TINY = [
    *("env=walker2d", "algo=ppo", "hardware=cpu", "physics=c", "num_envs=2", "evaluation.num_envs=1"),
    *("evaluation.gymnasium_episodes=1", "algo.unroll_length=2", "algo.num_unrolls=1", "algo.num_minibatches=1"),
    *("algo.policy_hidden_layer_sizes=[4]", "algo.value_hidden_layer_sizes=[4]"),
]


@pytest.fixture
def run(tmp_path):
    """Recorder, algorithm, first state and folder of a run with four steps per iteration."""
    config = load_config(TINY)
    task = make_task(config)
    algorithm = make_algorithm(task, config.num_envs, config.evaluation, config.algo)
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    state = jax.jit(algorithm.init)(jax.random.PRNGKey(0))
    return Recorder(config, algorithm, folder, Processes()), algorithm, state, folder


def with_best(algorithm, state, best_return, best_iteration):
    """A state whose evaluations found a policy with all parameters 7 to be the best."""
    best = jax.tree.map(lambda x: jnp.full_like(x, 7), algorithm.policy_params(state))
    evaluation = state.evaluation.replace(
        best_policy_params=best, best_return=jnp.float32(best_return), best_iteration=jnp.int32(best_iteration)
    )
    return state.replace(evaluation=evaluation), best


def kept(folder, name, algorithm, state):
    return load_policy(folder, name, algorithm.policy_params(state))


def assert_same(found, expected):
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_the_final_and_the_best_policy_are_kept(run, monkeypatch):
    recorder, algorithm, state, folder = run
    recorder.save(state, env_steps=4, wall_seconds=1.0)
    recorder.wait()
    params, metadata = kept(folder, "final", algorithm, state)
    assert_same(params, algorithm.policy_params(state))
    assert metadata["env_steps"] == 4
    assert choose_policy(folder, "best") == "final"  # no evaluation has ended

    state, best = with_best(algorithm, state, best_return=3.0, best_iteration=5)
    recorder.save(state, env_steps=80, wall_seconds=2.0)
    recorder.wait()
    params, metadata = kept(folder, choose_policy(folder, "best"), algorithm, state)
    assert_same(params, best)
    assert (metadata["env_steps"], metadata["eval_return"]) == (20, 3.0)
    params, metadata = kept(folder, "final", algorithm, state)
    assert_same(params, algorithm.policy_params(state))
    assert metadata["env_steps"] == 80

    written = []
    monkeypatch.setattr(recorder._saver, "save", lambda *parts: written.append([part.path.name for part in parts]))
    recorder.save(state, env_steps=84, wall_seconds=3.0)
    recorder.save(with_best(algorithm, state, 4.0, 6)[0], env_steps=88, wall_seconds=4.0)
    assert written == [["final", "0000000000084"], ["best", "final", "0000000000088"]]


def test_a_folder_without_a_final_policy_says_so(run):
    _, _, _, folder = run
    with pytest.raises(UserError, match="holds no policy yet"):
        choose_policy(folder, "final")
    folder.policy("best").mkdir()
    with pytest.raises(UserError, match="has kept only its best policy; choose policy=best"):
        choose_policy(folder, "final")
    with pytest.raises(UserError, match="policy=last: choose one of: final, best, medium, simple"):
        choose_policy(folder, "last")


def end(algorithm, state, final_return, monkeypatch):
    """The policies of a run whose training ends with a state, and whose last evaluation gives `final_return`."""
    monkeypatch.setattr(scoring, "evaluate", lambda task, num, policy, key: (jnp.full(num, final_return), None))
    return scoring.closing_policies(algorithm, [state], [None], seeds=[0], env_steps=80, steps_per_iteration=4)[0]


@pytest.mark.parametrize(("final", "best"), [(5.0, 9.0), (9.0, 5.0)])
def test_both_policies_are_scored_and_the_scores_choose_nothing(run, monkeypatch, final, best):
    _, algorithm, state, folder = run
    state, best_params = with_best(algorithm, state, best_return=10.0, best_iteration=5)
    acted = {}

    def score(task, act, num_episodes):
        acted[len(acted)] = np.asarray(act(np.ones(task.observation_size, np.float32)))
        value = final if len(acted) == 1 else best
        return Scores(np.full(num_episodes, value), np.full(num_episodes, 3), [0], task.gymnasium_id)

    monkeypatch.setattr(scoring, "score_in_gymnasium", score)
    policies = end(algorithm, state, 9.5, monkeypatch)  # less than the best one's 10
    scored = scoring.score_run(algorithm, policies, folder, num_episodes=1, training_seconds=1.0)
    assert {name: (scores.mean, steps) for name, (scores, steps) in scored.items()} == {
        "final": (final, 80),
        "best": (best, 20),
    }
    for index, params in enumerate((algorithm.policy_params(state), best_params)):
        expected = algorithm.policy(params)(jnp.ones(17), jax.random.PRNGKey(0))
        np.testing.assert_allclose(acted[index], expected, rtol=1e-5)
    file = read_scores(folder.gymnasium_scores)
    assert {name: (block["mean"], block["env_steps"]) for name, block in file.blocks.items()} == {
        "final": (final, 80),
        "best": (best, 20),
    }
    assert file.env == "Walker2d-v5" and file.metadata["wall_seconds"] == 1.0


def test_a_final_policy_with_the_highest_evaluation_is_also_the_best(run, monkeypatch):
    recorder, algorithm, state, folder = run
    state, _ = with_best(algorithm, state, best_return=10.0, best_iteration=5)
    scored_policies = []

    def score(task, act, num_episodes):
        scored_policies.append(act)
        return Scores(np.full(num_episodes, 4.0), np.full(num_episodes, 3), [0], task.gymnasium_id)

    monkeypatch.setattr(scoring, "score_in_gymnasium", score)
    policies = end(algorithm, state, 10.5, monkeypatch)
    recorder.save(state, env_steps=80, wall_seconds=1.0)
    recorder.save_policies(policies)
    scoring.score_run(algorithm, policies, folder, num_episodes=1, training_seconds=1.0)
    recorder.wait()
    params, metadata = kept(folder, "best", algorithm, state)
    assert_same(params, algorithm.policy_params(state))
    assert metadata == {"env_steps": 80, "eval_return": 10.5} and len(scored_policies) == 1
    blocks = read_scores(folder.gymnasium_scores).blocks
    assert blocks["final"] == blocks["best"] and blocks["best"]["eval_return"] == 10.5


def test_the_next_save_of_a_resumed_run_keeps_what_its_state_holds_as_the_best(run):
    recorder, algorithm, state, folder = run
    state, best = with_best(algorithm, state, best_return=10.0, best_iteration=5)
    recorder.save(state, env_steps=80, wall_seconds=1.0)
    recorder.wait()
    checkpoint.save(folder.policy("best"), algorithm.policy_params(state), {"env_steps": 80, "eval_return": 10.5})
    resumed = Recorder(load_config(TINY), algorithm, folder, Processes())
    restored, _ = restore_newest(folder.checkpoints, state, Processes())
    resumed.save(restored, env_steps=84, wall_seconds=2.0)
    resumed.wait()
    params, metadata = kept(folder, "best", algorithm, state)
    assert_same(params, best)
    assert metadata == {"env_steps": 20, "eval_return": 10.0}


@pytest.mark.parametrize(("seeds", "kept_steps"), [(1, [8]), (2, [4, 8])])
def test_seeds_that_train_together_keep_a_checkpoint_that_all_of_them_have(run, seeds, kept_steps):
    _, algorithm, state, folder = run
    recorder = Recorder(load_config([*TINY, "checkpoint.max_to_keep=1"]), algorithm, folder, Processes(), seeds)
    for env_steps in (4, 8):
        recorder.save(state, env_steps, wall_seconds=1.0)
    recorder.wait()
    assert [int(path.name) for path in checkpoint.list_steps(folder.checkpoints)] == kept_steps


ROW = {"env_steps": 4, "wall_seconds": 1.0}


def test_a_folder_that_vanishes_stops_the_run_and_is_not_made_again(run):
    recorder, _, state, folder = run
    recorder.begin(0, will_train=True, restored={})
    recorder.write(ROW)
    shutil.rmtree(folder.path)
    says = f"{folder.path} has vanished with everything saved in it"
    with pytest.raises(UserError, match=says):
        recorder.write(ROW)
    recorder.save(state, env_steps=4, wall_seconds=1.0)
    with pytest.raises(UserError, match=says):
        recorder.wait()
    recorder.close()
    assert not folder.path.exists()


def test_a_full_disk_costs_one_line_and_no_checkpoint(run, monkeypatch):
    recorder, algorithm, state, folder = run
    recorder.save(state, env_steps=4, wall_seconds=1.0)
    recorder.wait()
    usage = shutil.disk_usage(folder.path)
    monkeypatch.setattr("mjx_walk.storage.arrays.shutil.disk_usage", lambda path: usage._replace(free=10))
    recorder.save(state, env_steps=8, wall_seconds=2.0)
    says = rf"cannot write .*: No space left on device; .* continue with run_dir={folder.path} resume=true"
    with pytest.raises(UserError, match=says):
        recorder.save(state, env_steps=12, wall_seconds=2.0)
    recorder.close()
    assert [int(path.name) for path in checkpoint.list_steps(folder.checkpoints)] == [4]
    assert kept(folder, "final", algorithm, state)[1]["env_steps"] == 4


def test_a_policy_that_is_missing_or_damaged_is_in_the_checkpoint(run):
    recorder, algorithm, state, folder = run
    state, best = with_best(algorithm, state, best_return=3.0, best_iteration=5)
    recorder.save(state, env_steps=80, wall_seconds=2.0)
    recorder.wait()
    (folder.policy("best") / "meta.json").write_text("{")
    shutil.rmtree(folder.policy("final"))
    for name, params, metadata in (
        ("best", best, {"env_steps": 20, "eval_return": 3.0}),
        ("final", algorithm.policy_params(state), {"env_steps": 80}),
    ):
        with pytest.warns(UserWarning, match=rf"{name}.* is .*; the policy of the checkpoint at step 80 is used"):
            loaded = SavedPolicy(folder, policy=name)
        assert_same(loaded.policy_params, params)
        assert loaded.policy_metadata == metadata


def test_a_checkpoint_alone_can_be_scored(run, tmp_path):
    recorder, algorithm, state, folder = run
    recorder.save(state, env_steps=80, wall_seconds=2.0)
    recorder.wait()
    (path,) = checkpoint.list_steps(folder.checkpoints)
    alone = tmp_path / "alone"
    shutil.copytree(path, alone / "checkpoints" / path.name)
    with pytest.warns(UserWarning, match="the policy of the checkpoint at step 80 is used"):
        loaded = SavedPolicy(open_existing(alone))
    assert_same(loaded.policy_params, algorithm.policy_params(state))
