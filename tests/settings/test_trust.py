"""A reward function that the user has named runs again unnamed, as long as it is the same; nothing else does."""

import json
import shutil

import gymnasium
import pytest
from helpers import TINY, TINY_CALL, command_here, edit_config, train_here

from mjx_walk import api
from mjx_walk import train as train_command
from mjx_walk.envs import make_env
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.settings import trust
from mjx_walk.settings.saved_config import read_config, save_config
from mjx_walk.utils.errors import UserError

MODEL = f"{gymnasium.__path__[0]}/envs/mujoco/assets/walker2d_v5.xml"
REWARD = "import pathlib\npathlib.Path({ran!r}).touch()\nimport my_helper\ndef reward(step):\n    return step.terms\n"


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A user's home, with a reward file in the working directory."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    work = tmp_path / "work"
    write_reward(work, tmp_path / "ran")
    monkeypatch.chdir(work)
    return tmp_path


def write_reward(folder, ran):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "r.py").write_text(REWARD.format(ran=str(ran)))
    (folder / "my_helper.py").write_text("")


@pytest.fixture
def trained(home):
    """A run whose reward function was named on the command line, with a path relative to the working directory."""
    train_here("run", "env.reward_function=r.py:reward", f"total_steps={TINY_CALL}")
    (home / "ran").unlink()
    return home


def resume(run_dir, *arguments):
    train_here(run_dir, "resume=true", f"total_steps={2 * TINY_CALL}", *arguments, tiny=[])


def refused(capsys, *arguments):
    """The one line with which a resume is refused."""
    assert command_here("train", *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_named_reward_runs_again_from_any_folder(trained, monkeypatch):
    source = f"{trained}/work/r.py:reward"
    path = trained / "config" / "mjx_walk" / "trusted_reward_functions.json"
    assert path == trust.trust_file() and path.stat().st_mode & 0o777 == 0o600
    assert {*json.loads(path.read_text())[source]} == {f"{trained}/work/r.py", f"{trained}/work/my_helper.py"}
    assert read_config(trained / "work" / "run" / "config.yaml").env.reward_function == source
    other = trained / "other"
    write_reward(other, other / "ran")
    monkeypatch.chdir(other)
    resume(trained / "work" / "run")
    assert (trained / "ran").exists() and not (other / "ran").exists()


@pytest.mark.parametrize("name", ["r.py", "my_helper.py"])
def test_a_changed_file_is_refused_until_it_is_named(trained, capsys, name):
    (trained / "work" / name).write_text((trained / "work" / name).read_text() + "# changed\n")
    named = f"env.reward_function={trained}/work/r.py:reward"
    capsys.readouterr()
    line = refused(capsys, "run_dir=run", "resume=true")
    assert line == (f"error: {trained}/work/{name} has changed since you named it; to run it as it is now, add {named}")
    assert not (trained / "ran").exists()
    resume("run", named)
    assert (trained / "ran").exists()
    api.resolve(["run_dir=run", "resume=true"])  # the new content is trusted


def test_a_run_folder_with_its_own_file_and_hash_stays_a_strangers(home, capsys):
    train_here("run", f"total_steps={TINY_CALL}")
    run_dir = shutil.move("run", home / "stranger")
    write_reward(run_dir, home / "ran")
    source = f"{run_dir}/r.py:reward"
    hashes = make_env("walker2d", physics="c", reward_function=source).reward_hashes
    (home / "ran").unlink()
    own = run_dir / "mjx_walk" / "trusted_reward_functions.json"
    own.parent.mkdir()
    own.write_text(json.dumps({source: hashes}))
    edit_config(run_dir, "reward_function: null", f"reward_function: {source}")
    capsys.readouterr()
    line = refused(capsys, f"run_dir={run_dir}", "resume=true")
    assert line == f"error: the saved run uses the code of {source}; to run it, add env.reward_function={source}"
    assert not (home / "ran").exists()


def test_another_function_of_a_trusted_file_is_not_trusted(trained):
    edit_config(trained / "work" / "run", "r.py:reward", "r.py:another")
    with pytest.raises(UserError, match="to run it, add env"):
        api.resolve(["run_dir=run", "resume=true"])


def test_a_command_line_with_other_characters_is_quoted(home):
    """A user copies what a message says to type."""
    with pytest.raises(UserError, match=r"add 'env\.reward_function=x; touch owned:f'$"):
        trust.require_trusted("x; touch owned:f")


def test_a_moved_reward_file_may_be_named_on_a_resume(trained):
    shutil.copytree(trained / "work", trained / "moved", ignore=shutil.ignore_patterns("run"))
    (trained / "work" / "r.py").unlink()
    resume("run", f"env.reward_function={trained}/moved/r.py:reward")
    assert read_config(trained / "work" / "run" / "config.yaml").env.reward_function == f"{trained}/moved/r.py:reward"


@pytest.mark.parametrize("content", ["{", "[]", '{"a": 1}', '{"a": {"b": 1}}', "[" * 100_000, b"\xff", None])
def test_an_unusable_list_costs_one_warning_and_no_training(home, caplog, content):
    path = trust.trust_file()
    path.parent.mkdir(parents=True)
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    trust.remember(f"{home}/work/r.py:reward", {f"{home}/work/r.py": "0"})
    assert [record.levelname for record in caplog.records] == ["WARNING"] and "\n" not in caplog.text.strip()
    with pytest.raises(UserError, match="to run it, add env"):
        trust.require_trusted(f"{home}/work/r.py:reward")
    assert path.is_dir() if content is None else path.exists()


def test_a_list_that_cannot_be_written_costs_one_warning(home, capsys):
    (home / "config").write_text("a file where the folder should be")
    train_here("run", "env.reward_function=r.py:reward", f"total_steps={TINY_CALL}")
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("warning"))
    assert "trusted_reward_functions.json" in warning and f"env.reward_function={home}/work/r.py:reward" in warning
    assert "no usable" not in refused(capsys, "run_dir=run", "resume=true")


def test_paths_of_a_sweep_are_relative_to_the_folder_of_the_command(home, monkeypatch):
    trained = []
    monkeypatch.setattr(train_command, "train", lambda configs: (trained.append(configs[0]), None))
    monkeypatch.setattr("sys.argv", ["train"])
    shutil.copy(MODEL, home / "work" / "mine.xml")
    train_command.main(
        [
            *("-m", *TINY, "seed=0,1", "hydra.job.chdir=true"),
            *("run_dir=out", "env.xml_file=mine.xml", "env.reward_function=r.py:reward"),
        ]
    )
    assert len(trained) == 2
    for config in trained:
        assert config.env.reward_function == f"{home}/work/r.py:reward"
        assert config.env.xml_file == f"{home}/work/mine.xml" and config.run_dir == f"{home}/work/out"


def test_a_saved_asset_name_stays_gymnasiums_model(home):
    """Else a file of that name in the working directory of a resume would replace it in silence."""
    config = api.resolve(["env=walker2d", "env.xml_file=walker2d_v5.xml", "hardware=cpu"])
    assert config.env.xml_file == "walker2d_v5.xml"
    save_config(config, home / "config.yaml")
    (home / "work" / "walker2d_v5.xml").write_text("not a model")
    assert make_task(read_config(home / "config.yaml")).action_size == 6
    with pytest.raises(UserError, match=f"MuJoCo cannot read {home}/work/walker2d_v5.xml"):
        make_env("walker2d", physics="c", xml_file="./walker2d_v5.xml")
