"""Pickles and copies read a task's files again, and warn if one has changed."""

import copy
import pickle
import shutil

import gymnasium
import pytest

import mjx_walk
from mjx_walk.envs import make_env
from mjx_walk.envs.model_files import ASSETS
from mjx_walk.utils.errors import UserError

REWARD = "def twice(step):\n    return {'reward_twice': 2 * step.reward}\n"


def make_gymnasium(**files):
    return gymnasium.make("mjx_walk/InvertedPendulum-v5", physics="c", **files)


def make_many(**files):
    return gymnasium.make_vec("mjx_walk/InvertedPendulum-v5", num_envs=2, physics="c", **files)


def make_task(**files):
    return make_env("inverted_pendulum", "c", **files)


@pytest.fixture
def files(tmp_path):
    """Paths of a model and of a reward function."""
    model, reward = tmp_path / "mine.xml", tmp_path / "reward.py"
    model.write_bytes((ASSETS / "inverted_pendulum.xml").read_bytes())
    reward.write_text(REWARD)
    return model, reward


@pytest.mark.parametrize("make", [make_task, make_gymnasium, make_many])
def test_a_pickle_warns_if_a_file_has_changed(make, files, caplog):
    model, reward = files
    made = make(xml_file=str(model), reward_function=f"{reward}:twice")
    pickled = pickle.dumps(made)
    pickle.loads(pickled)
    assert not caplog.text
    for path, old, new in ((model, 'gear="100"', 'gear="50"'), (reward, "2 *", "3 *")):
        content = path.read_text()
        path.write_text(content.replace(old, new))
        for again in (lambda: pickle.loads(pickled), lambda: copy.deepcopy(made)):
            again()
            assert f"{path} has changed since it was loaded; it is used as it is now" in caplog.text
            assert caplog.text.count("has changed") == 1
            caplog.clear()
        path.write_text(content)
    model.unlink()
    with pytest.raises(UserError, match=r"model file not found: .*mine\.xml"):
        pickle.loads(pickled)


def test_a_pickled_run_warns_if_its_model_has_changed(caplog, tmp_path):
    path, folder = tmp_path / "mine.xml", tmp_path / "run"
    path.write_bytes((ASSETS / "walker2d_v5.xml").read_bytes())
    shutil.copytree(mjx_walk.load_run("zoo:walker2d-sac", "c").path, folder)
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("xml_file: null", f"xml_file: {path}"))
    pickled = pickle.dumps(mjx_walk.load_run(folder, "c"))
    pickle.loads(pickled)
    assert not caplog.text
    path.write_text(path.read_text() + "\n")
    pickle.loads(pickled)
    assert f"{path} has changed since it was loaded; it is used as it is now" in caplog.text
