"""How much of its return a policy keeps in the real Gymnasium when the physics change."""

import dataclasses
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mjx_walk.envs import Task
from mjx_walk.evaluation.gymnasium_scores import play_in_gymnasium
from mjx_walk.evaluation.perturbations import Perturbation
from mjx_walk.storage.files import write_text
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Act
from mjx_walk.utils.versions import package_versions

__all__ = ["STRENGTHS", "Cell", "Robustness", "measure_robustness"]

STRENGTHS: dict[str, tuple[float, ...]] = {
    "friction": (1.25, 1.5, 2.0, 3.0, 4.0),
    "mass": (1.1, 1.2, 1.3, 1.4, 1.5),
    "torque": (0.9, 0.8, 0.7, 0.6, 0.5),
    "latency": (0.005, 0.01, 0.02, 0.03, 0.04),
    "push": (0.2, 0.4, 0.6, 0.8, 1.0),
}
"""Five strengths of each field of `Perturbation`. Half of the episodes multiply friction and mass, and half divide."""
_TWO_SIDED = ("friction", "mass")
_TOGETHER = 2
"""Index of the strength of each change when all act together."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """Returns under one change of the physics."""

    name: str
    """A field of `Perturbation`, `nominal`, or `all`."""
    label: str
    """The strength, with its unit."""
    returns: Float[np.ndarray, " episodes"]

    @property
    def mean(self) -> float:
        return float(self.returns.mean())


@dataclasses.dataclass(frozen=True)
class Robustness:
    """Returns of one policy in 26 cells, and without changes."""

    env: str
    """Gymnasium's id."""
    nominal: Cell
    single: list[Cell]
    """One change at a time: each row of `STRENGTHS`, from weak to strong."""
    together: Cell
    """All changes at their middle strength."""

    @property
    def area(self) -> float:
        """Mean return over the cells with one change."""
        return float(np.mean([cell.mean for cell in self.single]))

    @property
    def worst(self) -> Cell:
        """The cell with the lowest mean return."""
        return min((*self.single, self.together), key=lambda cell: cell.mean)

    def lines(self) -> list[str]:
        """A table, and the summary."""
        rows = [f"  {'nominal':<10}{self.nominal.mean:>11,.1f}"]
        for name in STRENGTHS:
            cells = [cell for cell in self.single if cell.name == name]
            header = "".join(f"{cell.label:>11}" for cell in cells)
            values = "".join(f"{cell.mean:>11,.1f}" for cell in cells)
            rows += [f"  {name:<10}{header}", f"  {'':<10}{values}"]
        rows.append(f"  {'all':<10}{self.together.mean:>11,.1f}  at {self.together.label}")
        worst = self.worst
        return [
            f"{self.env}, mean return of {len(self.nominal.returns)} episodes a cell:",
            *rows,
            f"Area (mean of the cells with one change): {self._with_share(self.area)}",
            f"Worst cell: {worst.name} {worst.label}, {self._with_share(worst.mean)}",
        ]

    def _with_share(self, value: float) -> str:
        """A return, and its share of the nominal one where that is positive."""
        share = f", {round(100 * value / self.nominal.mean)}% of nominal" if self.nominal.mean > 0 else ""
        return f"{value:,.1f}{share}"

    def write(self, path: Path) -> None:
        """Write all returns as JSON, with the versions of the packages."""
        cells = [
            {"name": cell.name, "label": cell.label, "returns": cell.returns.tolist()}
            for cell in (*self.single, self.together)
        ]
        content = {
            "env": self.env,
            "nominal": self.nominal.returns.tolist(),
            "cells": cells,
            "area": self.area,
            "versions": package_versions(),
        }
        write_text(path, json.dumps(content, indent=1))


def measure_robustness(task: Task, act: Act, num_episodes: int, seed: int = 0) -> Robustness:
    """Score a policy in 26 cells of changed physics, and without changes.

    Args:
        task: the environment and its keywords.
        act: a JAX function `[N, observation_size] f32 → [N, action_size] f32`, both in Gymnasium's units.
        num_episodes: episodes of a cell. Those of every cell have the same starts.
        seed: episode i is reset with `seed + i`.

    Raises:
        UserError: Gymnasium has no equivalent environment, or the model file is gone.
    """
    if not task.is_in_gymnasium:
        raise UserError(f"robustness=true plays in Gymnasium, which has no equivalent of {task.options.name}")
    cells = [("nominal", "", {}), *_single_changes(), ("all", _together_label(), _together())]
    changes = [_change(strengths, i) for _, _, strengths in cells for i in range(num_episodes)]
    seeds = [int(seed) + i for _ in cells for i in range(num_episodes)]
    returns, _ = play_in_gymnasium(task, act, seeds, changes)
    nominal, *single, together = [
        Cell(name, label, own) for (name, label, _), own in zip(cells, np.split(returns, len(cells)), strict=True)
    ]
    return Robustness(task.gymnasium_id, nominal, single, together)


def _single_changes() -> list[tuple[str, str, dict[str, float]]]:
    """Name, label and change of each cell with one change."""
    return [
        (name, _label(name, strength), {name: strength})
        for name, strengths in STRENGTHS.items()
        for strength in strengths
    ]


def _together() -> dict[str, float]:
    return {name: strengths[_TOGETHER] for name, strengths in STRENGTHS.items()}


def _together_label() -> str:
    return ", ".join(f"{name} {_label(name, strength)}" for name, strength in _together().items())


def _label(name: str, strength: float) -> str:
    if name in _TWO_SIDED:
        return f"×/÷ {strength:g}"
    if name == "latency":
        return f"{strength * 1e3:g} ms"
    return f"{strength:g} m/s" if name == "push" else f"× {strength:g}"


def _change(strengths: dict[str, float], episode: int) -> Perturbation:
    """The changes of one episode of a cell: of four episodes, each combination of more or less friction and mass."""
    signs = dict(zip(_TWO_SIDED, (episode % 2, episode // 2 % 2), strict=True))
    if len(strengths) == 1:
        signs = dict.fromkeys(_TWO_SIDED, episode % 2)
    return Perturbation(**{name: 1 / value if signs.get(name) else value for name, value in strengths.items()})
