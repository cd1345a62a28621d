"""What README tells people to type."""

import re
from pathlib import Path

import jax.numpy as jnp
import pytest

from mjx_walk.envs import make_env

CLONE = Path(__file__).parent.parent
README = (CLONE / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_python_example(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (example,) = [block for block in blocks("python") if not block.startswith("# ")]
    exec(compile(example, "README.md", "exec"), {})
    assert "(16, 348)" in capsys.readouterr().out
    assert len(list(tmp_path.glob("runs/walker2d_ppo/*/eval_gymnasium.json"))) == 1


def test_own_reward(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, keyword = re.search(r"env=(\w+) env\.reward_function=(my_reward\.py:\w+)", README).groups()
    (own,) = [block for block in blocks("python") if block.startswith("# my_reward.py")]
    Path("my_reward.py").write_text(own)
    task = make_env(name, physics="c", reward_function=keyword)
    before = task.reset_to(task.init_qpos.at[4].set(-0.6), task.init_qvel)
    after = task.step(before, jnp.zeros(task.action_size))
    assert float(after.metrics["reward_knee"]) == pytest.approx(0.5 * abs(float(after.physics.qpos[4])))
    assert float(after.reward) == pytest.approx(sum(float(after.metrics[term]) for term in task.reward_terms))


def test_ci_runs_the_very_test_command():
    command = next(block.strip() for block in blocks("") if "pytest" in block)
    assert command.endswith(".venv/bin/pytest") and command in (CLONE / ".ci" / "run").read_text().splitlines()


def test_files_it_links_to_are_there():
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert target.startswith("http") or (CLONE / target).exists(), target
