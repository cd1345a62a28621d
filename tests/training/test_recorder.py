"""Which policy a run keeps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_walk.algos import make_algorithm
from mjx_walk.evaluation.gymnasium_scores import Scores
from mjx_walk.runs.config import load_config
from mjx_walk.runs.policies import load_best_policy, make_task
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.training.distributed import Processes
from mjx_walk.training.recorder import Recorder

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
    return Recorder(config, task, algorithm, folder, Processes()), algorithm, state, folder


def with_best(algorithm, state, best_return, best_iteration):
    """A state whose evaluations found a policy with all parameters 7 to be the best."""
    best = jax.tree.map(lambda x: jnp.full_like(x, 7), algorithm.policy_params(state))
    evaluation = state.evaluation.replace(
        best_policy_params=best, best_return=jnp.float32(best_return), best_iteration=jnp.int32(best_iteration)
    )
    return state.replace(evaluation=evaluation), best


def kept(folder, algorithm, state):
    return load_best_policy(folder, algorithm.policy_params(state))


def assert_same(found, expected):
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_the_best_policy_is_saved_once_evaluated_and_not_again_while_it_stays(run, monkeypatch):
    recorder, algorithm, state, folder = run
    recorder.save(state, env_steps=4, wall_seconds=1.0)
    recorder.wait()
    params, facts = kept(folder, algorithm, state)
    assert_same(params, algorithm.policy_params(state))  # none is known to be better yet
    assert facts["env_steps"] == 4

    state, best = with_best(algorithm, state, best_return=3.0, best_iteration=5)
    recorder.save(state, env_steps=80, wall_seconds=2.0)
    recorder.wait()
    params, facts = kept(folder, algorithm, state)
    assert_same(params, best)
    assert (facts["env_steps"], facts["eval_return"]) == (20, 3.0)

    written = []
    monkeypatch.setattr(recorder._saver, "save", lambda *parts: written.append([path.name for path, _, _ in parts]))
    recorder.save(state, env_steps=84, wall_seconds=3.0)
    recorder.save(with_best(algorithm, state, 4.0, 6)[0], env_steps=88, wall_seconds=4.0)
    assert [len(names) for names in written] == [1, 2] and written[1][0] == "best"


@pytest.mark.parametrize(("last", "best", "env_steps"), [(5.0, 9.0, 20), (9.0, 5.0, 80)])
def test_of_the_last_policy_and_the_best_one_gymnasium_chooses(run, monkeypatch, last, best, env_steps):
    """The last policy scores below the best one's inline evaluation of 10, so both are scored."""
    recorder, algorithm, state, folder = run
    state, best_params = with_best(algorithm, state, best_return=10.0, best_iteration=5)
    last_params = algorithm.policy_params(state)

    def score(params, num_episodes):
        is_best = float(jax.tree.leaves(params)[-1].ravel()[0]) == 7.0
        return Scores(np.full(num_episodes, best if is_best else last), np.full(num_episodes, 3), [0], "Walker2d-v5")

    monkeypatch.setattr(recorder, "_score_in_gymnasium", score)
    monkeypatch.setattr("mjx_walk.viewing.run_plots.plot_run", lambda folder: None)
    recorder.begin(0, will_train=True)
    recorder.end(state, env_steps=80)
    scores = recorder.score(wall_seconds=1.0)
    recorder.wait()
    params, facts = kept(folder, algorithm, state)
    assert scores.mean == 9.0 and facts["env_steps"] == env_steps
    assert_same(params, best_params if best > last else last_params)
    assert f'"env_steps": {env_steps}' in folder.gymnasium_scores.read_text()
