"""Scores of a policy, and `eval_gymnasium.json`, which holds those of a run's policies in the real Gymnasium."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack, cast

import numpy as np

from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.checksums import read_json, take_checksum, with_checksum
from mjx_walk.storage.files import write_text
from mjx_walk.utils.versions import package_versions

__all__ = [
    "BEST",
    "BETTER",
    "FINAL",
    "MILESTONES",
    "POLICIES",
    "ScoreBlock",
    "ScoreFile",
    "Scores",
    "read_scores",
    "write_scores",
]

FINAL = "final"
"""The policy of the newest checkpoint, at the end of the training so far."""
BEST = "best"
"""The policy with the highest evaluation during training or at its end."""
MILESTONES = {"medium": 2 / 3, "simple": 1 / 3}
"""Policies that a run keeps on request: the fraction of the way from the first evaluation to the best one, by name."""
POLICIES = (FINAL, BEST, *MILESTONES)
"""Names of the policies that a run may keep."""
BETTER = "better"
"""The better of both, chosen on the scored episodes themselves: what a file with one block holds."""

_MAX_NUMBER = 1e300
_MAX_BYTES = 10_000_000
"""About 125,000 episodes of both policies."""


@dataclasses.dataclass
class Scores:
    """Undiscounted returns and lengths of complete episodes."""

    returns: np.ndarray
    """`[N] f64`."""
    lengths: np.ndarray
    """`[N] i64`."""
    seeds: list[int]
    """In Gymnasium the seed of each episode's reset; in an engine the one seed of all episodes."""
    env: str
    """Gymnasium's name, followed by the engine if it is not Gymnasium's."""
    measures: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """`[N] f64` each: means of the task's measures over an episode, by name with unit. Gymnasium's tasks have none."""

    @property
    def mean(self) -> float:
        return float(self.returns.mean())

    @property
    def std(self) -> float:
        """The sample's standard deviation over episodes (n − 1); 0 for one episode."""
        return float(self.returns.std(ddof=1)) if len(self.returns) > 1 else 0.0

    def __str__(self) -> str:
        count = len(self.returns)
        return (
            f"{self.env}: {self.mean:,.1f} ± {self.std:,.1f} over {count} {'episode' if count == 1 else 'episodes'}, "
            f"mean length {self.lengths.mean():,.1f}, lowest {self.returns.min():,.1f}"
        )

    @property
    def measures_line(self) -> str:
        """Means of the measures over episodes; empty without measures."""
        return ", ".join(f"{name}: {values.mean():.3g}" for name, values in self.measures.items())

    def block(self, **metadata: Unpack[Metadata]) -> "ScoreBlock":
        """All episodes and their mean and deviation, for `write_scores`.

        Args:
            metadata: facts about the policy, such as `env_steps`.
        """
        found: ScoreBlock = {
            "mean": self.mean,
            "std": self.std,
            "returns": self.returns.tolist(),
            "lengths": self.lengths.tolist(),
            "seeds": self.seeds,
            **metadata,
        }
        if self.measures:
            found["measures"] = {name: values.tolist() for name, values in self.measures.items()}
        return found


class ScoreBlock(Metadata, total=False):
    """Scores of one policy, as JSON, and facts about it."""

    mean: float
    """Mean return."""
    std: float
    """Standard deviation over episodes."""
    returns: list[float]
    lengths: list[int]
    seeds: list[int]
    measures: dict[str, list[float]]
    """Absent without measures."""


@dataclasses.dataclass(frozen=True)
class ScoreFile:
    """Contents of an `eval_gymnasium.json`."""

    env: str
    """Gymnasium's id of the environment."""
    blocks: dict[str, ScoreBlock]
    """`Scores.block` of each scored policy, by its name: `final`, `best`, or `better` in a file with one block."""
    metadata: dict[str, Any]
    """Everything else, such as `versions`, `wall_seconds` and `command`."""

    def block(self, *names: str) -> ScoreBlock | None:
        """The first block that the file has of these names."""
        return next((self.blocks[name] for name in names if name in self.blocks), None)


def write_scores(path: Path, env: str, blocks: Mapping[str, ScoreBlock], metadata: Mapping[str, object]) -> None:
    """Write scores as JSON, with the versions of the packages and a checksum.

    Args:
        path: file to replace.
        env: Gymnasium's id of the environment.
        blocks: `Scores.block` of each scored policy, by its name.
        metadata: JSON-serializable metadata about the run. They do not replace the scores, whatever their names are.
    """
    scores = {"env": env, **blocks}
    others = {name: fact for name, fact in metadata.items() if name not in scores}
    content = scores | others | {"versions": package_versions()}
    write_text(path, json.dumps(with_checksum(content), indent=1))


def read_scores(path: Path) -> ScoreFile:
    """Read scores that `write_scores` wrote. A file with one block, of an older version, loads as well.

    Raises:
        ValueError: the file is not of this format, or was changed.
        OSError: it is not a regular file, or cannot be read.
    """
    try:
        content = read_json(path, _MAX_BYTES)
    except ValueError as error:
        raise ValueError(f"{path} holds no scores: {error}") from error
    if not take_checksum(content):
        raise ValueError(f"{path} was changed after it was written: its checksum does not match")
    env = content.pop("env", "")
    if "returns" in content:  # one block, without a name
        names = ("mean", "std", "returns", "lengths", "seeds", "env_steps")
        blocks = {BETTER: {name: content.pop(name) for name in names if name in content}}
    else:
        blocks = {name: content.pop(name) for name in (*POLICIES, BETTER) if name in content}
    for name, block in blocks.items():
        if not (isinstance(block, dict) and _are_numbers(block.get("mean"), block.get("std"))):
            raise ValueError(f"{path} has no mean and std of the policy '{name}'")
    if not isinstance(env, str) or not blocks:
        raise ValueError(f"{path} holds no scores")
    return ScoreFile(env, cast(dict[str, ScoreBlock], blocks), content)


def _are_numbers(*values: Any) -> bool:
    return all(type(value) in (int, float) and abs(value) < _MAX_NUMBER for value in values)
