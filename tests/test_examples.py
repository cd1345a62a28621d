"""The examples of `docs/`: they train and play outside the repository."""

import importlib.util
import re
import shlex
import subprocess
import sys

import pytest
from helpers import (
    CLONE,
    ENVIRONMENT,
    PAGES,
    TINY,
    TINY_CALL,
    command_here,
    fenced,
    renders,
    train_here,
    unregistered,
)

import mjx_walk
from mjx_walk.envs import registry

OWN_ROBOT = CLONE / "docs" / "examples" / "own_robot.py"
PAGE = (CLONE / "docs" / "your_own.md").read_text()
needs_dm_control = pytest.mark.skipif(
    importlib.util.find_spec("dm_control") is None, reason="no models: pip install --no-deps dm_control"
)


@pytest.fixture(autouse=True)
def _unregistered():
    with unregistered():
        yield


def train_robot(tmp_path, *arguments):
    """Train the example, copied out of the repository, for one call."""
    file = tmp_path / "own_robot.py"
    file.write_text(OWN_ROBOT.read_text())
    arguments = (f"env.task={file}:Walker", "env.max_episode_steps=20", f"total_steps={TINY_CALL}", *arguments)
    train_here(tmp_path / "run", *arguments, tiny=TINY[1:])
    return tmp_path / "run"


@needs_dm_control
@pytest.mark.dm_control
@renders
def test_own_robot_trains_and_plays(tmp_path, capsys):
    run = train_robot(tmp_path)
    assert len(OWN_ROBOT.read_text().splitlines()) <= 60
    film = tmp_path / "film.mp4"
    assert command_here("play", f"run={run}", f"out={film}", "width=64", "height=64") == 0
    assert "walker: return" in capsys.readouterr().out and film.stat().st_size > 500


@needs_dm_control
@pytest.mark.slow
@pytest.mark.parametrize("engine", [pytest.param("jax", marks=pytest.mark.long), "warp"])
def test_own_robot_trains_on_mjx(engine, tmp_path):
    run = train_robot(tmp_path, f"physics={engine}", "evaluation.gymnasium_episodes=1")
    scores = mjx_walk.load_run(run).evaluate(episodes=2)
    assert scores.env == f"walker on {engine}" and 0 < scores.returns.mean() < 20


@needs_dm_control
@pytest.mark.slow
def test_the_observation_is_the_same_on_every_engine(tmp_path):
    name = registry.register_task_file(f"{OWN_ROBOT}:Walker")
    c, warp = (mjx_walk.make_env(name, physics=engine) for engine in ("c", "warp"))
    qpos = c.init_qpos.at[0].set(-0.02)  # off the edge where the feet touch
    found, expected = (task.step(task.reset_to(qpos, task.init_qvel), task.action_high) for task in (warp, c))
    assert abs(found.obs - expected.obs).max() < 1e-3 and abs(found.reward - expected.reward) < 1e-4


def test_own_algorithm_trains(tmp_path):
    (code,) = re.findall(r"```python\n(# huber_a2c\.py\n.*?)```", PAGE, flags=re.DOTALL)
    exec(compile(code, "huber_a2c.py", "exec"), {"__name__": "huber_a2c"})
    small = [argument for argument in TINY if "num_epochs" not in argument]
    run = mjx_walk.run([*small, "algo=huber_a2c", "algo.huber_delta=0.5", "total_steps=1", f"run_dir={tmp_path}/run"])
    assert run.config.algo.name == "huber_a2c" and run.metrics[-1]["train/value_loss"] >= 0
    assert run.config.algo.init_noise_std == 0.5  # of the recipe of A2C


def shell_line(page, text):
    """The line of a page's blocks that contains a text, as arguments of this interpreter."""
    (line,) = [
        line for block in fenced(PAGES[CLONE / "docs" / page], "") for line in block.splitlines() if text in line
    ]
    return [sys.executable, *shlex.split(line.partition("python ")[2])]


@pytest.mark.slow
def test_the_reproduction_steps_on_a_cpu(tmp_path):
    """The first of its commands. The second one needs two GPUs."""
    sizes = {"NUM_ENVS": "2", "NUM_STEPS": "1", "REFERENCE": f"{tmp_path}/reference.npy", "JAX_PLATFORMS": "cpu"}
    arguments = shell_line("multi_gpu.md", "multi_gpu_repro.py one")
    done = subprocess.run(arguments, cwd=CLONE, env=ENVIRONMENT | sizes, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "difference after one step 0.0e+00, finite True" in done.stdout


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("rl_zoo3") is None, reason="pip install rl_zoo3")
def test_rl_zoo3_trains_with_the_page_s_settings(tmp_path):
    settings = next(block for block in fenced(PAGES[CLONE / "docs" / "gymnasium.md"], "") if "settings.yml" in block)
    (tmp_path / "settings.yml").write_text(settings)
    arguments = [*shell_line("gymnasium.md", "rl_zoo3.train"), "--n-timesteps", "2048"]
    done = subprocess.run(arguments, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
