"""Datasets of Minari hold episodes that Gymnasium repeats bit for bit."""

import os
import re
import shutil
import subprocess
import sys
from collections import namedtuple

import numpy as np
import pytest
from helpers import CLONE, ENVIRONMENT, OLD_RUNS, blocks, command_here, edit_config, train_here
from small_robot import small_robot

import mjx_walk
from mjx_walk.envs import make_env
from mjx_walk.envs.model_files import ASSETS
from mjx_walk.evaluation import recorded_episodes, simulated_episodes
from mjx_walk.storage.checkpoint_metadata import read_metadata, write_metadata
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.versions import git_commit

minari = pytest.importorskip("minari", reason="pip install 'minari[hdf5]'")
from mjx_walk.interop.minari import check_task  # noqa: E402

KEEPS_ONE = "a complete training with checkpoint.milestones=true keeps one"
REACHER = "mjx_walk/reacher/csac-v0"


def export(*arguments):
    return command_here("export", "format=minari", *arguments)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """A folder with episodes of the zoo's Reacher, and of a walker of v4 that falls."""
    folder = tmp_path_factory.mktemp("datasets")
    assert export("run=zoo:reacher-csac", "episodes=100", "seed=1000", f"out={folder}") == 0
    run = shutil.copytree(OLD_RUNS / "ppo", folder / ".runs" / "falls")
    edit_config(run, "  version: v5\n", "  version: v4\n")
    edit_config(run, "  max_episode_steps: 3\n", "  max_episode_steps: 1000\n")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(recorded_episodes, "MAX_PARALLEL_EPISODES", 2)
        patched.setenv("MINARI_DATASETS_PATH", str(folder))
        assert export(f"run={run}", "policy=final", "episodes=3") == 0
    return folder


@pytest.fixture
def load(datasets, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(datasets))
    return minari.load_dataset


def assert_repeats(dataset, seeds):
    """Play the actions again from the stored seeds."""
    env = dataset.recover_environment()
    metadata = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
    assert [facts["seed"] for facts in metadata] == seeds
    for episode, seed in zip(dataset.iterate_episodes(), seeds, strict=True):
        assert episode.observations.dtype == np.float64 and episode.actions.dtype == env.action_space.dtype
        assert all(env.action_space.contains(action) for action in episode.actions)
        obs, info = env.reset(seed=seed)
        steps = [(obs, 0.0, False, False, info), *(env.step(action) for action in episode.actions)]
        obs, rewards, terminated, truncated, infos = zip(*steps, strict=True)
        np.testing.assert_array_equal(episode.observations, obs)
        np.testing.assert_array_equal(episode.rewards, rewards[1:])
        np.testing.assert_array_equal(episode.terminations, terminated[1:])
        np.testing.assert_array_equal(episode.truncations, truncated[1:])
        assert episode.infos.keys() == infos[1].keys()
        for name, values in episode.infos.items():
            np.testing.assert_array_equal(values, [info.get(name, np.nan) for info in infos])


def test_gymnasium_repeats_the_episodes(load):
    dataset = load(REACHER)
    assert dataset.recover_environment().spec.id == "Reacher-v5" and dataset.total_steps == 5_000
    assert_repeats(dataset, list(range(1_000, 1_100)))


def test_gymnasium_repeats_episodes_that_end_early_in_v4(load):
    dataset = load("mjx_walk/walker2d/ppo-final-v0")
    lengths = {len(episode) for episode in dataset.iterate_episodes()}
    assert dataset.recover_environment().spec.id == "Walker2d-v4"
    assert len(lengths) == 3 and max(lengths) < 1_000
    assert_repeats(dataset, [0, 1, 2])


def test_minari_lists_the_datasets_with_their_facts(load, datasets):
    listed = minari.list_local_datasets()
    assert listed.keys() == {REACHER, "mjx_walk/walker2d/ppo-final-v0"}
    assert set(minari.namespace.list_local_namespaces()) == {*("mjx_walk", "mjx_walk/reacher", "mjx_walk/walker2d")}
    run = mjx_walk.load_run("zoo:reacher-csac")
    facts = listed[REACHER]
    assert facts["algorithm_name"] == "csac" and facts["requirements"][0].startswith("mujoco==3.17")
    own = facts["mjx_walk"]
    assert (own["run"], own["policy"], own["seed"]) == ("zoo:reacher-csac", "best", 1000)
    assert own["env_steps"] == run.policy_metadata["env_steps"]
    assert own["versions"]["mjx_walk"] == mjx_walk.__version__
    own = listed["mjx_walk/walker2d/ppo-final-v0"]["mjx_walk"]
    returns = [episode.rewards.sum() for episode in load("mjx_walk/walker2d/ppo-final-v0").iterate_episodes()]
    assert own["mean_return"] == pytest.approx(np.mean(returns)) and own["run"] == "falls"
    assert own["std_return"] == pytest.approx(np.std(returns, ddof=1))
    scores = mjx_walk.load_run(datasets / ".runs" / "falls", policy="final").evaluate(3)
    assert scores.returns == pytest.approx(returns, rel=1e-4)


def test_datasets_can_be_combined_and_split(load):
    """Minari's own functions accept them."""
    first, second = minari.split_dataset(load(REACHER), sizes=[60, 40], seed=0)
    assert (first.total_episodes, second.total_steps) == (60, 2_000)
    assert len(first.sample_episodes(2)) == 2 and "reward_dist" in repr(second[0])


def test_episodes_of_the_engine_are_those_that_it_scores(datasets, load, monkeypatch):
    """Three episodes in batches of two, which fall at different times."""
    run = datasets / ".runs" / "falls"
    monkeypatch.setattr(simulated_episodes, "episodes_at_once", lambda task: 2)
    monkeypatch.setattr(simulated_episodes, "_CHUNK", 7)
    assert export(f"run={run}", "episodes=3", "seed=5", "backend=sim", f"out={datasets}") == 0
    dataset = load("mjx_walk/walker2d/ppo-best-sim-v0")
    scores = mjx_walk.load_run(run).evaluate(3, backend="sim", seed=5)
    episodes = list(dataset.iterate_episodes())
    assert [len(episode) for episode in episodes] == scores.lengths.tolist() and len({*scores.lengths}) > 1
    np.testing.assert_allclose([episode.rewards.sum() for episode in episodes], scores.returns, rtol=1e-5)
    act = mjx_walk.load_run(run).policy
    for episode in episodes:
        assert episode.terminations.nonzero()[0].tolist() == [len(episode) - 1] and not episode.truncations.any()
        np.testing.assert_allclose(episode.actions, act(episode.observations[:-1]), atol=1e-6)
        terms = [episode.infos[name][1:] for name in ("reward_forward", "reward_ctrl", "reward_survive")]
        np.testing.assert_allclose(np.sum(terms, 0), episode.rewards, atol=1e-5)
        assert np.isnan(episode.infos["reward_forward"][0])
    assert dataset.recover_environment().spec.id == "Walker2d-v4"
    own = minari.load_dataset("mjx_walk/walker2d/ppo-best-sim-v0").storage.metadata["mjx_walk"]
    assert (own["backend"], own["physics"], own["seed"]) == ("sim", "c", 5)
    shutil.rmtree(datasets / "mjx_walk" / "walker2d" / "ppo-best-sim-v0")


def test_the_engine_plays_what_gymnasium_lacks(datasets, tmp_path, capsys):
    """Minari then knows the spaces, and no environment."""
    run = shutil.copytree(OLD_RUNS / "ppo", tmp_path / "hills")
    edit_config(run, "  version: v5\n", "  version: v5\n  ground:\n    slope: 15.0\n")
    assert export(f"run={run}", "episodes=1", f"out={tmp_path}/new") == 2
    assert capsys.readouterr().err == (
        "error: format=minari plays in Gymnasium, whose floor has no hills; add backend=sim\n"
    )
    assert export(f"run={run}", "episodes=1", "backend=sim", f"out={tmp_path}/new") == 0
    dataset = minari.MinariDataset(tmp_path / "new" / "mjx_walk" / "walker2d" / "ppo-best-sim-v0" / "data")
    (episode,) = dataset.iterate_episodes()
    assert dataset.env_spec is None
    assert dataset.observation_space.contains(episode.observations[0]) and dataset.action_space.shape == (6,)


def test_example_of_the_documentation(datasets):
    (example,) = [block for block in blocks("python") if block.startswith("# read_dataset.py")]
    example = example.replace("mjx_walk/walker2d/csac-v0", REACHER)
    example += '\nassert not {"jax", "mjx_walk"} & set(__import__("sys").modules)'
    variables = ENVIRONMENT | {"MINARI_DATASETS_PATH": str(datasets)}
    done = subprocess.run([sys.executable, "-c", example], env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "(51, 10) (50, 2) -" in done.stdout


@pytest.mark.slow
def test_a_clone_reaches(datasets):
    """The example, with fewer updates and episodes. Return is minus the distance to the goal, over 50 steps."""
    variables = ENVIRONMENT | {"MINARI_DATASETS_PATH": str(datasets), "XLA_FLAGS": ""}
    line = [sys.executable, str(CLONE / "docs" / "examples" / "behaviour_cloning.py"), REACHER, "1000", "20"]
    done = subprocess.run(line, env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    means = {who: float(value) for who, value in re.findall(r"^(\w+): ([-\d.]+) ±", done.stdout, re.MULTILINE)}
    assert means["untrained"] < -20 < -6 < means["clone"] and -5 < means["dataset"] < -2


def test_datasets_of_several_policies(datasets, tmp_path, monkeypatch, capsys):
    """They hold the episodes of `policy=`, under names of their own."""
    run = shutil.copytree(datasets / ".runs" / "falls", tmp_path / "run")
    for name in ("medium", "simple"):
        shutil.copytree(run / "checkpoints" / "best", run / "checkpoints" / name)
    metadata = read_metadata(run / "checkpoints" / "medium" / "meta.json")
    write_metadata(run / "checkpoints" / "medium" / "meta.json", metadata | {"fraction": 0.6})
    out = ("episodes=2", "seed=7", f"out={tmp_path / 'new'}")
    assert export(f"run={run}", "policies=expert,medium", *out) == 0
    said = capsys.readouterr().out
    assert re.search(r"medium policy \(step [\d,]+, 60% of the way to the best\)\nWalker2d-v4: ", said)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "new"))
    for quality, policy, fraction in (("expert", "best", None), ("medium", "medium", 0.6)):
        name = f"mjx_walk/walker2d/ppo-{quality}-v0"
        assert f'  {quality} = minari.load_dataset("{name}")' in said
        dataset = minari.load_dataset(name)
        assert_repeats(dataset, [7, 8])
        own = dataset.storage.metadata["mjx_walk"]
        assert (own["policy"], own["seed"], own.get("fraction")) == (policy, 7, fraction)
        assert own.get("commit") == git_commit()
    assert export(f"run={run}", "policies=simple,expert", *out) == 2
    assert "ppo-expert-v0 exists already" in capsys.readouterr().err
    assert not (tmp_path / "new" / "mjx_walk" / "walker2d" / "ppo-simple-v0").exists()


@pytest.mark.slow
def test_a_training_gives_three_qualities(tmp_path, monkeypatch):
    """A pendulum that learns to balance for longer."""
    settings = ("num_envs=64", "total_steps=16_384", "iterations_per_call=1", "algo.unroll_length=16")
    further = ("evaluation.num_envs=16", "evaluation.gymnasium_episodes=0", "checkpoint.milestones=true")
    train_here(tmp_path / "run", "hardware=cpu", *settings, *further, tiny=["env=inverted_pendulum"])
    out = ("policies=expert,medium,simple", "episodes=20", f"out={tmp_path / 'new'}")
    assert export(f"run={tmp_path / 'run'}", *out) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "new"))
    names = [f"mjx_walk/inverted_pendulum/ppo-{quality}-v0" for quality in ("simple", "medium", "expert")]
    means = [minari.load_dataset(name).storage.metadata["mjx_walk"]["mean_return"] for name in names]
    assert 20 < means[0] < means[1] < means[2]


def test_a_run_without_milestones_says_how_to_keep_them(tmp_path, capsys):
    run = OLD_RUNS / "ppo"
    for arguments, message in (
        (("policies=expert,medium",), f"{run} has no medium policy; {KEEPS_ONE}"),
        (("policy=simple",), f"{run} has no simple policy; {KEEPS_ONE}"),
        (("policies=best",), "policies=best: give some of: expert,medium,simple"),
        (("policies=",), "policies=: give some of: expert,medium,simple"),
        (("policies=expert", "policy=best"), "give policy=NAME or policies=NAME,NAME, not both"),
        (
            ("policies=expert", "format=onnx"),
            "policies=expert has no effect with format=onnx; change that, or leave it out",
        ),
    ):
        assert export(f"run={run}", f"out={tmp_path}/new", *arguments) == 2
        assert capsys.readouterr().err == f"error: {message}\n"
    assert not os.listdir(tmp_path)


def test_what_gymnasium_cannot_replay_is_refused(tmp_path):
    (tmp_path / "robot.xml").write_text(small_robot())
    (tmp_path / "walker.xml").write_text((ASSETS / "walker2d.xml").read_text())
    for name, options, message in (
        ("locomotion", {"xml_file": tmp_path / "robot.xml"}, "which has no locomotion; add backend=sim"),
        ("walker2d", {"xml_file": tmp_path / "walker.xml"}, "without your model"),
        ("walker2d", {"ground": {"slope": 15.0}}, "whose floor has no hills"),
    ):
        with pytest.raises(UserError, match=message):
            check_task(make_env(name, physics="c", **options))
    check_task(make_env("walker2d", physics="c", xml_file="walker2d.xml"))


def test_mistakes_print_one_line_and_leave_nothing(datasets, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    for arguments, message in (
        (("out=",), "a path is empty"),
        (("out=file",), "file is a file; choose another path"),
        ((f"out={datasets}",), f"{datasets}/{REACHER} exists already; choose another out=, or remove it"),
        (("backend=real",), "backend=real: choose one of: gymnasium, sim"),
        (("format=onnx", "backend=sim"), "backend=sim has no effect with format=onnx"),
    ):
        assert export("run=zoo:reacher-csac", *arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ") and message in line
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize(
    ("failing", "code", "said"),
    [("disk_usage", 2, "error: [Errno 28] No space left on device: "), ("make_gymnasium", 130, "Stopped by Ctrl-C.")],
)
def test_a_dataset_that_is_not_finished_is_removed(failing, code, said, tmp_path, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    full = namedtuple("usage", "free")(2**20)
    fail = {"disk_usage": lambda path: full, "make_gymnasium": interrupt}[failing]
    monkeypatch.setattr(f"mjx_walk.interop.minari.{'shutil.' if failing == 'disk_usage' else ''}{failing}", fail)
    assert export("run=zoo:reacher-csac", "episodes=2", f"out={tmp_path}/new") == code
    assert capsys.readouterr().err.startswith(said) and not os.listdir(tmp_path / "new")


def test_without_minari_the_command_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert export("run=zoo:reacher-csac", f"out={tmp_path}/new") == 2
    assert capsys.readouterr().err == "error: format=minari needs Minari: pip install 'minari[hdf5]'\n"


@pytest.mark.slow
def test_the_output_loads_the_dataset(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert export("run=zoo:reacher-csac", "episodes=1", "out=a folder") == 0
    *_, shell, python = capsys.readouterr().out.splitlines()
    code = f"import minari\n{python.strip()}\nprint(dataset.total_steps)"
    line = f"{shell.strip()}; cd /; {sys.executable} -c '{code}'"
    done = subprocess.run(line, shell=True, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.stdout == "50\n", done.stderr
