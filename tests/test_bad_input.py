"""Each mistake gets one clear line that names the valid choices, exit code 2, and costs nothing."""

import dataclasses
import errno
import os
import subprocess
import sys

import pytest
from helpers import TINY, TINY_CALL, command, command_here, edit_config, train_here

from mjx_walk import api, tune
from mjx_walk import bench as bench_command
from mjx_walk import compare as compare_command
from mjx_walk import eval as eval_command
from mjx_walk import train as train_command
from mjx_walk.algos import ALGORITHMS
from mjx_walk.cli import parsing
from mjx_walk.envs import TASKS
from mjx_walk.settings.config import Config, flatten, load_config
from mjx_walk.storage import run_folder
from mjx_walk.utils.errors import UserError

CASES = [
    (["env=snake"], f"unknown env 'snake'; choose one of: {', '.join(TASKS)}"),
    (["env=[ant]"], "unknown env '['ant']'; did you mean: ant?"),
    (["algo={a:b}"], "unknown algo '{'a': 'b'}'; choose one of: ppo"),
    (["-m", ""], "an argument is empty; write KEY=VALUE"),
    (["seed=1", "seeds=2"], "give seed=N or seeds=[…], not both"),
    (["seeds=[1,1]"], "seeds=[1, 1]: give a number of seeds, or a list of different seeds from 0 up"),
    (["algo=dqn"], f"unknown algo 'dqn'; choose one of: {', '.join(ALGORITHMS)}"),
    (["physics=bullet"], "physics=bullet: choose one of: auto, warp, jax, c"),
    (["env.version=v3"], "env.version=v3: choose one of: v5, v4"),
    (["recipe=nope"], "recipes for env=humanoid algo=ppo: cpu/humanoid_ppo, gpu/humanoid_ppo"),
    (["recipe=report/e_td3", "algo=sac"], "recipe=report/e_td3 does not fit env=humanoid algo=sac; add algo=td3"),
    (["device=2"], "unknown key 'device'; did you mean: devices?"),
    (["seedz=2"], "unknown key 'seedz'; did you mean: seed, seeds?"),
    (["num_env=4"], "unknown key 'num_env'; did you mean: num_envs"),
    (["algo.discont=0.9"], "unknown key 'algo.discont'; did you mean: algo.discount"),
    (["+extra=1"], "'+extra=1': keys cannot be added or removed"),
    (["++extra=1"], "keys cannot be added or removed"),
    (["~seed"], "keys cannot be added or removed"),
    (["humanoid"], "cannot read 'humanoid'; write env=humanoid"),
    (["csac"], "cannot read 'csac'; write algo=csac"),
    (["env", "humanoid"], "cannot read 'env humanoid'; write env=humanoid"),
    (["--num_envs", "5"], "cannot read '--num_envs 5'; write num_envs=5"),
    (["--num-envs=5"], "cannot read '--num-envs=5'; write num_envs=5"),
    (["--resume", "seed=1"], "cannot read '--resume'; write resume=true"),
    (["-m", "seed=0,1", "--env", "humanoid"], "cannot read '--env humanoid'; write env=humanoid"),
    (["runs/x"], "cannot read 'runs/x'; write KEY=VALUE"),
    (["num_envs=many"], "num_envs=many: must be an integer"),
    (["num_envs=0"], "num_envs=0: must be at least 1"),
    (["total_steps=-5"], "total_steps=-5: must be at least 1"),
    (["algo.learning_rate=nan"], "algo.learning_rate=nan: must be a number"),
    (["algo.learning_rate=0"], "algo.learning_rate=0.0: must be above 0"),
    (["algo.learning_rate=inf"], "must be finite"),
    (["algo.discount=1.5"], "must be at most 1"),
    (["algo.activation=sinus"], "algo.activation=sinus: choose one of: celu"),
    (["env.frame_skip=0"], "env.frame_skip=0: must be at least 1"),
    (["env.reset_noise_scale=-1"], "must be at least 0"),
    (["env.xml_file=nowhere.xml"], "model file not found"),
    (["algo=sac", "algo.replay_capacity=10_000_000_000"], "lower algo.replay_capacity"),
    (["algo=sac", "algo.replay_capacity=1000"], "algo.learning_starts=10000 is more than algo.replay_capacity"),
    (
        ["algo=reinforce", "algo.discount=0.999"],
        "above algo.max_tail_discount=0.2; lengthen it, or lower algo.discount",
    ),
    (["algo=a2c", "algo.min_log_std=3"], "algo.min_log_std=3.0 is above algo.max_log_std=2.0"),
    (["env.reward_function=mine.py:f"], "mine.py'; write PATH.py:FUNCTION"),
    (["env.xml_file="], "env.xml_file= names no file; write its path, or env.xml_file=null"),
    (["env.reward_function="], "env.reward_function= names no file; write its path, or env.reward_function=null"),
    (["env.reward_function=f"], "env.reward_function=f: no file 'f'; write PATH.py:FUNCTION"),
    (["env.shaping.faling=1"], "unknown key 'env.shaping.faling'; did you mean: env.shaping.falling"),
    (["algo=td3", "algo.policy_delay=3"], "must be a multiple of algo.policy_delay=3"),
    (["algo=sac", "algo.tau=0"], "algo.tau=0.0: must be above 0"),
    (["algo=sac", "algo.final_discount=1"], "algo.final_discount=1.0: must be below 1"),
    (["algo=csac", "algo.target_entropy=3"], "algo.target_entropy=3.0: must be below 0.69"),
    (["algo.target_kl=0.1"], "has no effect with algo.learning_rate_schedule=linear; change that, or leave it out"),
    (["env=humanoid_standup", "env.uph_cost_weight=2"], "env.uph_cost_weight=2.0 has no effect here; leave it out"),
    (["algo=dqn", "--help"], "unknown algo 'dqn'; choose one of: ppo, sac"),
    (["num_envs=7"], "choose num_envs a multiple of 16"),
    (["env.name=walker2d"], "env.name=walker2d: choose one of: humanoid"),
    (["env=walker2d", "env.version=v4", "env.frame_skip=2"], "walker2d v4 does not take frame_skip"),
    (["resume=true"], "resume=true needs run_dir"),
    (["-m", "hydra/launcher=nowhere", "seed=0,1"], "Could not find 'hydra/launcher/nowhere' Available options"),
    (["-m", "env=ant,hopper", "seeds=2"], "seeds=… does not go with -m; leave it out, or sweep seeds"),
    (["-m", "seed=0,1", "--cfg", "job"], "-m trains a sweep and --cfg prints a configuration"),
    (["resume=true", "run_dir=/nowhere/at/all"], "no run at '/nowhere/at/all'"),
]


@pytest.mark.parametrize(("arguments", "says"), CASES, ids=[" ".join(case[0]) for case in CASES])
def test_train_names_the_mistake(arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        train_command.main(arguments)
    assert says in str(error.value) and "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


EVAL_CASES = [
    ([], "say which run"),
    (["run=/nowhere"], "no run at '/nowhere'"),
    (["run=x", "episodes=0"], "episodes=0: must be at least 1"),
    (["run=x", "episodes=ten"], "episodes=ten"),
    (["run=x", "physics=jax"], "physics=jax needs backend=sim"),
    (["run=x", "backend=brax"], "choose one of: gymnasium, sim"),
    (["run=x", "epsodes=3"], "unknown key 'epsodes'; valid: run, policy, episodes, backend, seed, physics"),
    (["runs/x"], "cannot read 'runs/x'; write run=runs/x"),
    (["run", "x"], "cannot read 'run x'; write run=x"),
    (["--episodes", "5"], "cannot read '--episodes 5'; write episodes=5"),
]


@pytest.mark.parametrize(("arguments", "says"), EVAL_CASES)
def test_eval_names_the_mistake(arguments, says):
    with pytest.raises(UserError) as error:
        eval_command.main(arguments)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_a_command_prints_one_line_and_exits_with_2(tmp_path):
    done = command("train", "env=snake", cwd=tmp_path)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if line]
    assert len(lines) == 1 and lines[0].startswith("error: "), done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("module", "argument"),
    [("eval", "run=nowhere"), ("bench", "env=snake"), ("parity", "x=1"), ("compare", "seeds=0"), ("plots", "x=1")],
)
def test_so_do_the_others(module, argument, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command_here(module, argument) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def test_bench_names_its_own_keys():
    with pytest.raises(UserError, match=r"unknown key 'second'; did you mean: seconds, seed\?"):
        bench_command.main(["second=3"])


@pytest.mark.parametrize(
    "command", [train_command.Own, bench_command.Arguments, compare_command.Arguments, tune.Arguments]
)
def test_no_setting_is_taken_for_a_command_s_own(command):
    own = {field.name for field in dataclasses.fields(command)}
    for env, algo in [*((env, "ppo") for env in TASKS), *(("humanoid", algo) for algo in ALGORITHMS)]:
        settings = [f"{key}=1" for key in flatten(load_config([f"env={env}", f"algo={algo}"])) if key not in own]
        assert parsing.parse_own(command, Config, settings, "")[1] == settings


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_takes_nothing_costs_one_line(number, monkeypatch, capsys):
    def fail(_):
        raise OSError(number, os.strerror(number), "some/file")

    with pytest.raises(SystemExit) as ended:
        parsing.main(fail)
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"error: [Errno {number}] {os.strerror(number)}: 'some/file'\n"


def test_what_can_be_written_is_not_left_behind(tmp_path):
    parsing.check_writable(tmp_path / "new" / "file")
    assert list((tmp_path / "new").iterdir()) == []
    (tmp_path / "old").write_text("x")
    parsing.check_writable(tmp_path / "old")
    assert (tmp_path / "old").read_text() == "x"


def test_warp_missing(monkeypatch):
    from mjx_walk.envs import physics

    monkeypatch.setattr(physics.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"physics=warp needs Warp: install it with pip install 'mjx-walk\[warp\]'"):
        physics.resolve_engine("warp")
    assert physics.resolve_engine("auto") == "c"


def test_a_folder_that_is_not_ours_is_left_alone(tmp_path):
    theirs = tmp_path / "thesis"
    theirs.mkdir()
    (theirs / "chapter.tex").write_text("years of work")
    file = tmp_path / "file"
    file.write_text("x")
    for path, says in ((theirs, "exists and is not a run folder"), (file, "is a file"), ("/proc/no", "cannot write")):
        with pytest.raises(UserError, match=says):
            train_command.main([*TINY, f"run_dir={path}"])
    assert [p.name for p in theirs.iterdir()] == ["chapter.tex"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A tiny run."""
    path = tmp_path_factory.mktemp("runs") / "run"
    train_here(path, f"total_steps={2 * TINY_CALL}")
    return path


def test_a_finished_run_is_not_overwritten(finished):
    before = (finished / "metrics.jsonl").read_text()
    with pytest.raises(UserError, match="holds a run already; add resume=true"):
        train_command.main([*TINY, f"run_dir={finished}"])
    assert (finished / "metrics.jsonl").read_text() == before


def test_resume_names_the_keys_that_differ(finished):
    same = [*TINY, f"run_dir={finished}", "resume=true", f"total_steps={2 * TINY_CALL}"]
    with pytest.raises(UserError) as error:
        train_command.main([*same, "algo.discount=0.5", "seed=9"])
    assert "algo.discount (was 0.99, now 0.5)" in str(error.value) and "seed (was 0, now 9)" in str(error.value)
    with pytest.raises(UserError) as error:
        train_command.main([f"run_dir={finished}", "resume=true", "checkpoint.max_to_keep=5"])
    assert ": checkpoint.max_to_keep (was 3, now 5); give only run_dir and resume=true to continue" in str(error.value)
    with pytest.raises(UserError, match="may only grow"):
        train_command.main([*same[:-1], f"total_steps={TINY_CALL}"])
    with pytest.raises(
        UserError, match=r"other settings: env\.name \(was walker2d, now humanoid\); and \d+ more; give "
    ):
        train_command.main([*same, "env=humanoid"])


def test_a_policy_of_another_environment_is_refused(finished, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    setting = "exclude_current_positions_from_observation"
    edit_config(copy, f"{setting}: true", f"{setting}: false")
    with pytest.raises(UserError, match=r"belongs to another run or version: .* should be \(18"):
        api.load_run(copy)
    shutil.rmtree(copy / "checkpoints")
    (copy / "config.yaml").write_text("not: ours\n")
    with pytest.raises(UserError, match="not a configuration of this version"):
        api.load_run(copy)
    shutil.copy(finished / "config.yaml", copy / "config.yaml")
    with pytest.raises(UserError, match="holds no policy yet"):
        api.load_run(copy)
    assert run_folder.open_existing(finished).path == finished


def test_a_bare_envs_is_refused(tmp_path):
    code = "import sys; sys.path.insert(0, sys.argv[1]); import envs"
    clone = str(run_folder.Path(__file__).parent.parent)
    done = subprocess.run([sys.executable, "-c", code, clone], capture_output=True, text=True, check=False)
    assert "import mjx_walk.envs, not envs" in done.stderr
