"""Trained policies that come with the package: `run=zoo:humanoid-ppo` wherever a run folder is accepted.

Each is a run folder with nothing in it but its configuration, its policy in one file, and its score in the real
Gymnasium. `python -m mjx_walk.zoo` lists them.
"""

import json
import shutil
from pathlib import Path

from mjx_walk.runs.run_folder import RunFolder, open_existing
from mjx_walk.utils.errors import UserError

PREFIX = "zoo:"

_FOLDER = Path(__file__).parent


def names() -> list[str]:
    """The policies there are."""
    return sorted(path.parent.name for path in _FOLDER.glob("*/config.yaml"))


def find(run: str) -> Path:
    """The folder of `zoo:NAME`.

    Raises:
        UserError: there is none of that name.
    """
    name = run.removeprefix(PREFIX)
    if name not in names():
        raise UserError(f"no policy '{name}' in the zoo; choose one of: {', '.join(names())}")
    return _FOLDER / name


def open_run(run: str | Path | None) -> RunFolder:
    """The folder of a run, or of `zoo:NAME`.

    Raises:
        UserError: none is given, or there is no run at that path.
    """
    return open_existing(find(run) if isinstance(run, str) and run.startswith(PREFIX) else run)


def output_path(folder: RunFolder, name: str) -> Path:
    """Where a file made from a policy goes: into its run folder; for the zoo here, under the policy's name."""
    return Path(f"{folder.path.name}{Path(name).suffix}") if holds(folder.path) else folder.path / name


def holds(folder: Path) -> bool:
    """Whether a run folder is one of these, which are not written to."""
    return folder.resolve().parent == _FOLDER.resolve()


def table() -> str:
    """All policies with their scores and the commands that made them, in Markdown."""
    lines = ["| run | score in Gymnasium | command |", "| --- | --- | --- |"]
    for name in names():
        facts = json.loads((_FOLDER / name / "eval_gymnasium.json").read_text())
        score = f"{facts['env']}: {facts['mean']:,.0f} ± {facts['std']:,.0f}"
        lines.append(f"| `{PREFIX}{name}` | {score} | `{facts['command']}` |")
    return "\n".join(lines)


def empty_folder(name: str) -> Path:
    """Where to put a policy of that name; one that is there is removed."""
    folder = _FOLDER / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder
