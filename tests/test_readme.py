"""The commands, code and links of README and the documentation."""

import dataclasses
import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest
from fake_runs import fake_run
from helpers import (
    CLONE,
    ENVIRONMENT,
    PAGES,
    TINY,
    TINY_OFF_POLICY,
    blocks,
    command,
    command_here,
    unregistered,
)
from shared_programs import shared_programs
from small_robot import small_robot

import mjx_walk
from mjx_walk import zoo
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.envs import make_env
from mjx_walk.experiments import planned_runs, trials
from mjx_walk.settings.config import load_config
from mjx_walk.storage.scores import MILESTONES
from mjx_walk.training.trainer import Trainer

RESULTS = (CLONE / "docs" / "results.md").read_text()
CHANGE_A_TASK = (CLONE / "docs" / "change_a_task.md").read_text()
RUN_ELSEWHERE = ("bench", "parity", "compare suite=", "export run=zoo:humanoid-csac format=hub")
"""Commands that tests of their own run, at sizes of their own."""


PROGRAMS = {
    "play_an_episode.py": r"return 1[23],\d{3}",
    "from_python.py": r"\(16, 348\)",
    "in_gymnasium.py": "",
    "in_brax.py": "",
    "in_gymnax.py": "",
    "with_another_id.py": "",
    "read_data.py": r"\[.* 0\.\d+ *\] \d+",
    "train_sb3.py": "",
    "in_torch.py": "",
    "train_many_sb3.py": "",
    "in_rsl_rl.py": "",
    "follow_a_training.py": r"step [\d,]+: return \d+\n",
}
"""Python blocks that run on their own, with a pattern of what they print."""
NEEDS = {"train_sb3.py": "stable_baselines3", "train_many_sb3.py": "stable_baselines3", "in_torch.py": "torch"}
NEEDS |= {"in_rsl_rl.py": "rsl_rl"}
"""Packages that are installed for campaigns only."""

RUN_BY_OTHER_TESTS = {
    "my_reward.py": "test_own_reward",
    "heavy_torso.py": "test_own_body",
    "without_jax.py": "interop/test_onnx.py",
    "read_dataset.py": "interop/test_minari.py",
    "in_rejax.py": "interop/test_gymnax_env.py",
    "brax_pendulum.py": "interop/test_external_runs.py",
    "huber_a2c.py": "test_examples.py",
}


def file(name):
    """What the documentation shows under this name."""
    (content,) = [block for block in blocks("python") if block.startswith(f"# {name}\n")]
    return content


def test_every_python_block_is_run():
    names = [block.partition("\n")[0].removeprefix("# ") for block in blocks("python")]
    assert sorted(names) == sorted([*PROGRAMS, *RUN_BY_OTHER_TESTS])


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_program(name, tmp_path):
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    code = file(name).replace("learn(100_000)", "learn(2_048)")
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.search(PROGRAMS[name], done.stdout)


def test_own_reward(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, keyword = re.search(r"env=(\w+) env\.reward_function=(my_reward\.py:\w+)", CHANGE_A_TASK).groups()
    Path("my_reward.py").write_text(file("my_reward.py"))
    task = make_env(name, physics="c", reward_function=keyword)
    before = task.reset_to(task.init_qpos.at[4].set(-0.6), task.init_qvel)
    after = task.step(before, jnp.zeros(task.action_size))
    assert float(after.metrics["reward_knee"]) == pytest.approx(0.5 * abs(float(after.physics.qpos[4])))
    assert float(after.reward) == pytest.approx(sum(float(after.metrics[term]) for term in task.reward_terms))


def test_ci_runs_the_very_test_command():
    command = next(block.strip() for block in blocks("") if "pytest" in block)
    assert command.endswith(".venv/bin/pytest") and command in (CLONE / ".ci" / "run").read_text().splitlines()


def slug(title):
    """The anchor of a heading, as GitHub and MyST make it."""
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def test_files_they_link_to_are_there():
    for page, text in PAGES.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            name, _, heading = target.partition("#")
            linked = page.parent / name if name else page
            assert target.startswith("http") or linked.exists(), f"{page}: {target}"
            if heading and not target.startswith("http"):
                headings = re.findall(r"^#+ (.*)$", linked.read_text(), flags=re.MULTILINE)
                assert heading in map(slug, headings), f"{page}: {target}"


def test_own_body(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pattern = r"python heavy_torso\.py && python -m \S+ env=(\w+) env\.xml_file=(\S+?)`"
    name, xml = re.search(pattern, CHANGE_A_TASK).groups()
    exec(compile(file("heavy_torso.py"), "heavy_torso.py", "exec"), {})
    task = make_env(name, physics="c", xml_file=xml)
    assert task.model.body_mass[1] == pytest.approx(10.0) != make_env(name, physics="c").model.body_mass[1]
    assert task.gymnasium_kwargs()["xml_file"] == str(tmp_path / xml)


def test_commands_of_the_tables_are_recipes():
    """The commands of the scores, whose recipes are for a GPU."""
    commands = re.findall(r"\| `(env=[^`]+)` \|$", RESULTS, flags=re.MULTILINE)
    commands += re.findall(r"\| `python -m mjx_walk\.train (env=[^`]+)` \|$", RESULTS, flags=re.MULTILINE)
    assert len(commands) > 25 and zoo.table() in RESULTS
    for line in commands:
        config = load_config(["hardware=gpu", *shlex.split(line)])
        assert config.total_steps > 1e6 and f"algo={config.algo.name}" in line


def all_commands():
    """All that start a command, in blocks and in sentences; of alternatives the first, and no mere names. Tables, whose
    commands differ in the recipe alone, are looked at above."""
    found = set()
    for text in PAGES.values():
        fenced = r"```\w*\n(.*?)```"
        lines = [line for block in re.findall(fenced, text, flags=re.DOTALL) for line in block.splitlines()]
        lines += re.findall(r"`([^`]+)`", re.sub(rf"{fenced}|^\|.*?$", "", text, flags=re.DOTALL | re.MULTILINE))
        for line in lines:
            first_of_each = re.sub(r"\|\S*", "", " ".join(line.split()))
            found |= set(re.findall(r"python -m mjx_walk\.(zoo|\w+ [^&]+\S)", first_of_each))
    return sorted(line for line in found if not line.startswith(RUN_ELSEWHERE))


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("readme") / "run"
    mjx_walk.run([*TINY, f"run_dir={folder}", "total_steps=1", "evaluation.gymnasium_episodes=1"])
    for name in MILESTONES:  # `training/test_milestones.py` trains for them
        shutil.copytree(folder / "checkpoints" / "best", folder / "checkpoints" / name)
    return folder


def sizes(arguments):
    """Sizes of a small run, where the algorithm has them and the arguments give no other.

    A sweep over algorithms, which differ in what they have, keeps the sizes of its recipes.
    """
    if any(re.match(r"algo=.*,", argument) for argument in arguments):
        return []
    of_the_command = ("-", "hydra.", "seeds=", "devices=")
    # The first value of a sweep. A comma in brackets belongs to a list.
    first_job = [re.sub(r"^([^\[]*?),.*", r"\1", one) for one in arguments if not one.startswith(of_the_command)]
    config = load_config([*first_job, "run_dir=null"])
    have = {f"algo.{field.name}" for field in dataclasses.fields(config.algo)} | {"num_envs", "evaluation.num_envs"}
    given = {argument.split("=")[0] for argument in arguments}
    # REINFORCE learns from short unrolls only with a large tail.
    on_policy = (*TINY, "algo.max_tail_discount=0.95")
    tiny = on_policy if isinstance(config.algo, OnPolicyConfig) else TINY_OFF_POLICY
    return [setting for setting in tiny if setting.split("=")[0] in have - given]


OWN_PROCESS = r"train .*devices="
"""Commands that run in a process of their own. The tests' process, which runs the others, has the imports already."""

TRAINED_ELSEWHERE = {
    r"train env=humanoid algo=\w+$": "storage/test_old_runs.py",
    r"train .*\bseeds=": "training/test_seeds.py",
    r"train -m ": "test_train.py",
    r"train env.task=brax_pendulum": "interop/test_external_runs.py",
}
"""Commands with the test that trains so to the end. Here, they end when JAX has traced their programs."""


def only_trace(trainer):
    """What takes the place of `Trainer.train`."""
    trainer._program.lower(trainer._keys, None)


def finish_at_once(job, *_):
    """What takes the place of `planned_runs.start_job`; `experiments/test_comparison.py` trains."""
    for run in job:
        fake_run(run.folder.path, [*run.overrides, f"seed={run.config.seed}"], [1.0, 2.0], score=3.0)
    return subprocess.Popen(["true"])


def evaluate_at_once(job, *arguments, **_):
    """What takes the place of `trials.start_job`; `experiments/test_tuning.py` trains."""
    process = finish_at_once(job, *arguments)
    for run in job:
        rows = [json.loads(line) for line in run.folder.metrics.read_text().splitlines()]
        lines = (json.dumps(row | {"eval/return": 1.0, "eval/env_steps": 1}) + "\n" for row in rows)
        run.folder.metrics.write_text("".join(lines))
    return process


def smaller(line):
    """A command with fewer jobs: of two algorithms, or of one where another setting is swept, and few seeds."""
    line = re.sub(r"( -m .*\bseed=\d+,\d+)\S*", r"\1", line)
    line = re.sub(r"(algo=\w+,\w+ seed=\d+)\S*", r"\1", line)
    line = re.sub(r"(algos=\[\w+),[^]]+(\].*=[^,\s]+,)", r"\1\2", line)
    line = re.sub(r"(algos=\[\w+,\w+)[^]]*", r"\1", line)
    line = re.sub(r"( recipe=\w[^,]+,[^,]+),\S+", r"\1", line)
    return re.sub(r" seeds=\d+", " seeds=2", line)


@pytest.mark.slow
@pytest.mark.parametrize("line", all_commands())
def test_every_command(line, small_run, tmp_path, monkeypatch, capfd):
    """As it stands there, but for sizes and places."""
    monkeypatch.chdir(tmp_path)
    exec(compile(file("heavy_torso.py"), "heavy_torso.py", "exec"), {})
    Path("go2.xml").write_text(small_robot())
    Path("brax_pendulum.py").write_text(file("brax_pendulum.py"))
    if "own_robot.py" in line:
        pytest.importorskip("dm_control")
        shutil.copytree(CLONE / "docs" / "examples", "docs/examples")
    line = re.sub(r" (num_envs=N|total_steps=N|viewer=true)", "", line)
    line = line.replace("env=TASK", "env=walker2d").replace("algo=ALGORITHM", "algo=ppo")
    line = line.replace("RUN_DIR", str(small_run)).replace("zoo:NAME", "zoo:inverted_pendulum-csac")
    line = re.sub(r"=(PATH|DIR|/shared/humanoid)", f"={tmp_path}/there", smaller(line))
    name, *arguments = shlex.split(line)
    if "resume=true" in arguments:
        arguments = [f"run_dir={small_run}", "resume=true"]
    elif name == "compare" and "draw=true" in arguments:
        arguments = ["draw=true", f"out={small_run.parent}"]
    elif name == "train" and not {"--cfg", "--help"} & {*arguments}:
        short = ["total_steps=1", "evaluation.gymnasium_episodes=1"]
        if "init_from=runs/walk" in arguments:
            source = [*arguments[:2], "run_dir=runs/walk"]
            assert command_here(name, *source, *sizes(source), *short) == 0
        if "init_from=zoo:walker2d-csac" in arguments:  # of the recipe for a GPU
            arguments += ["hardware=gpu", *(one for one in sizes(arguments) if "hidden_layer_sizes" not in one), *short]
        else:
            arguments += [*sizes(arguments), *short]
    elif "robustness=true" in arguments:
        arguments += ["episodes=1"]
    elif "format=minari" in arguments:
        pytest.importorskip("minari")
        arguments += ["episodes=1"]
    elif name == "play":
        arguments += ["width=96", "height=64"]
    elif name == "tune":
        pytest.importorskip("optuna")
        monkeypatch.setattr(trials, "start_job", evaluate_at_once)
        small = ["trials=2", "total_steps=1"]
        if "draw=true" in arguments:
            assert command_here(name, "env=walker2d", "algo=sac", *small) == 0
        else:
            arguments = [one for one in arguments if not one.startswith(("trials=", "total_steps="))] + small
    elif name == "compare":
        arguments = [argument for argument in arguments if not argument.startswith(("seeds=", "total_steps="))]
        arguments += ["seeds=1", "total_steps=1"]
        monkeypatch.setattr(planned_runs, "start_job", finish_at_once)
    if any(re.match(pattern, line) for pattern in TRAINED_ELSEWHERE):
        monkeypatch.setattr(Trainer, "train", only_trace)
        monkeypatch.setattr(Trainer, "score", lambda trainer: None)
    if name == "train":
        monkeypatch.setattr("mjx_walk.viewing.run_plots.plot_run", lambda folder: None)
    if re.match(OWN_PROCESS, line):
        done = command(name, *arguments, timeout=900)
        assert done.returncode == 0, f"{name} {shlex.join(arguments)}\n{done.stdout}\n{done.stderr}"
        return
    with unregistered(), shared_programs():
        assert command_here(name, *arguments) == 0, f"{name} {shlex.join(arguments)}\n{capfd.readouterr()}"
