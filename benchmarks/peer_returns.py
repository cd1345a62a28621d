"""Returns of another library's policies, kept during its training and scored as ours."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mjx_walk.envs import make_env
from mjx_walk.evaluation.gymnasium_scores import score_in_gymnasium
from mjx_walk.logs.metrics import write_csv

__all__ = ["KeptPolicy", "write_returns"]


@dataclasses.dataclass
class KeptPolicy:
    """A policy on the way."""

    steps: int
    seconds: float
    """Of training until then, with compiling and without saving."""
    act: Callable[[Any], Any]
    """`[N, observation_size] → [N, action_size]`, without noise."""


def write_returns(folder: Path, task_name: str, kept: list[KeptPolicy], episodes: int) -> None:
    """Score policies on the episodes of `python -m mjx_walk.eval`, print the scores and write them as `returns.csv`.

    Args:
        folder: of the file.
        task_name: such as `humanoid`.
        kept: by their steps.
        episodes: of the last policy; the others have a fifth of them.
    """
    task = make_env(task_name, physics="c")
    rows = []
    for one in kept:
        scores = score_in_gymnasium(task, one.act, episodes if one is kept[-1] else -(-episodes // 5))
        figures = {"mean": round(scores.mean, 2), "std": round(scores.std, 2)}
        rows.append({"steps": one.steps, "seconds": round(one.seconds, 1), "episodes": len(scores.returns)} | figures)
        print(rows[-1], flush=True)
    write_csv(rows, folder / "returns.csv")
