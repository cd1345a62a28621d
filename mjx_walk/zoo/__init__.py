"""Policies that the package ships, and their lookup: `run=zoo:humanoid-ppo` works wherever a run folder does.

Each is a run folder with only its configuration, its best policy in one file and its score in the real Gymnasium. Code
that trains or scores policies does not belong here. `python -m mjx_walk.zoo` lists the policies.
"""

import shutil
from pathlib import Path

from mjx_walk.storage.files import user_path
from mjx_walk.storage.run_folder import PREFIX, RunFolder, open_existing
from mjx_walk.storage.scores import BEST, read_scores
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import near_misses
from mjx_walk.utils.text import format_score

__all__ = ["PREFIX", "empty_folder", "holds", "names", "open_run", "output_path", "table"]

_FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Names of all policies."""
    return sorted(path.parent.name for path in _FOLDER.glob("*/config.yaml"))


def open_run(run: str | Path | None) -> RunFolder:
    """Open the folder of a run, or of `zoo:NAME`.

    Raises:
        UserError: no run is given, or there is none of that path or name.
    """
    if run is None or not str(run):
        raise UserError(f"say which run: run=RUN_DIR, or run={PREFIX}NAME; python -m mjx_walk.zoo lists the names")
    if not str(run).startswith(PREFIX):
        if str(run) in names() and not user_path(run).exists():
            raise UserError(f"no run at '{run}'; did you mean: {PREFIX}{run}?")
        return open_existing(run)
    name = str(run).removeprefix(PREFIX)
    if name not in names():
        near = near_misses(name, names()) or [known for known in names() if name and known.startswith(f"{name}-")]
        hint = (
            f"did you mean: {', '.join(PREFIX + known for known in near)}?"
            if near
            else f"choose one of: {', '.join(names())}"
        )
        raise UserError(f"no policy '{name}' in the zoo; {hint}")
    return RunFolder(_FOLDER / name)


def output_path(folder: RunFolder, name: str) -> Path:
    """Default path of a file made from a policy: in its run folder, or named after a zoo policy in the current one."""
    return Path(f"{folder.path.name}{Path(name).suffix}") if holds(folder.path) else folder.path / name


def holds(folder: Path) -> bool:
    """Whether a run folder belongs to the zoo, where commands must not write."""
    return folder.resolve().parent == _FOLDER.resolve()


def table() -> str:
    """All policies with their scores and the commands that trained them, in Markdown."""
    lines = [
        "| Run | Task | Score | Std over episodes | Best of runs | Mean of these runs | Command |",
        "| --- | --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for name in names():
        scores = read_scores(RunFolder(_FOLDER / name).gymnasium_scores)
        block, metadata = scores.blocks[BEST], scores.metadata
        mean, std, runs_mean = (format_score(x) for x in (block["mean"], block["std"], metadata["runs_mean"]))
        num_runs, command = str(metadata["num_runs"]), f"`{metadata['command']}`"
        cells = [f"`{PREFIX}{name}`", scores.env, mean, std, num_runs, runs_mean, command]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def empty_folder(name: str) -> RunFolder:
    """Make an empty folder for a policy; an existing one is removed."""
    folder = _FOLDER / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return RunFolder(folder)
