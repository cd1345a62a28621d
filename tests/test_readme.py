"""What README tells people to type."""

import re
from pathlib import Path

CLONE = Path(__file__).parent.parent
README = (CLONE / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_python_example(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (example,) = blocks("python")
    exec(compile(example, "README.md", "exec"), {})
    assert "(16, 348)" in capsys.readouterr().out
    assert len(list(tmp_path.glob("runs/walker2d_ppo/*/eval_gymnasium.json"))) == 1


def test_ci_runs_the_very_test_command():
    command = next(block.strip() for block in blocks("") if "pytest" in block)
    assert command.endswith(".venv/bin/pytest") and command in (CLONE / ".ci" / "run").read_text().splitlines()


def test_files_it_links_to_are_there():
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert target.startswith("http") or (CLONE / target).exists(), target
