"""Scores of the seeds on which no recipe was tuned, from the logs of their runs in measured/fresh_seeds.tar.xz."""

import functools
import itertools
import tarfile
import tempfile
from pathlib import Path

import numpy as np

from generator.markdown import table
from mjx_walk.experiments.budgets import at_budgets
from mjx_walk.experiments.logged_runs import LoggedRun, interval, read_runs
from mjx_walk.experiments.suite import REFERENCES
from mjx_walk.storage.scores import BEST, FINAL
from mjx_walk.utils.text import format_score

ARCHIVE = Path(__file__).parents[1] / "measured" / "fresh_seeds.tar.xz"
"""For each run its `config.yaml`, `inputs.json`, `metrics.jsonl` and `eval_gymnasium.json`."""

_HAD_A_GPU = {("Walker2d-v5", "csac")}
"""The runs whose process had a GPU to itself."""
_ALONE_SECONDS = {("Humanoid-v5", "csac"): "297", ("Humanoid-v5", "ppo"): "274"}
"""Training time of one seed that has the GPU to itself: LP1.s104 and EK1 of the log."""
_STOPPED_SECONDS = {("Reacher-v5", "ppo"): 488}
"""How long a process was stopped to let others train."""


@functools.cache
def runs() -> list[LoggedRun]:
    """The runs of the archive, by task, algorithm and seed."""
    with tempfile.TemporaryDirectory() as folder, tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
        found = read_runs(Path(folder))
    tasks = list(REFERENCES)
    return sorted(found, key=lambda run: (tasks.index(run.task), run.config.algo.name, run.config.seed))


def recipes() -> list[dict[str, str]]:
    """The final policies of each recipe, with the columns of results.csv."""
    rows = []
    for (task, algorithm), same in _blocks():
        scores = _means(same, FINAL)
        row = {
            **{"task": task, "algorithm": shown_algorithm(algorithm), "policy": FINAL},
            **{"score": _in_csv(np.mean(scores)), "std": _in_csv(np.std(scores, ddof=1))},
            **{"lowest_seed": _in_csv(min(scores)), "seeds": str(len(same)), "million_steps": _millions(same[0])},
            **{"seconds": f"{_seconds(same[0]):.0f}", "seeds_per_process": f"{same[0].seeds_together:.0f}"},
            **{"time_of": "training" + ", GPU shared" * ((task, algorithm) not in _HAD_A_GPU)},
            **{"alone_seconds": _ALONE_SECONDS.get((task, algorithm), "")},
            "command": f"env={same[0].config.env.name} algo={algorithm}",
        }
        rows.append(row)
    return rows


def seeds() -> str:
    """The final and the best policy of every seed."""
    rows = []
    for run in runs():
        final, best = ([block["mean"], block["std"], min(block["returns"])] for block in map(run.score, (FINAL, BEST)))
        rows.append(
            [run.task, shown_algorithm(run.config.algo.name), str(run.config.seed), *map(format_score, final + best)]
        )
    titles = ("Task", "Algorithm", ">Seed", ">Final", ">Std", ">Lowest", ">Best", ">Its std", ">Its lowest")
    return table(titles, rows)


def means() -> str:
    """Means over the seeds, with Student's 95% intervals."""
    rows = []
    for (task, algorithm), same in _blocks():
        final, best = _means(same, FINAL), _means(same, BEST)
        values = (np.mean(final), np.std(final, ddof=1), *interval(np.asarray(final)), min(final), np.mean(best))
        cells = [format_score(float(value)) for value in values]
        rows.append([task, shown_algorithm(algorithm), *cells, _millions(same[0]), f"{_seconds(same[0]):,.0f}"])
    titles = ("Task", "Algorithm", ">Final, mean over seeds", ">Std over seeds", ">Interval from", ">Interval to")
    return table((*titles, ">Lowest seed", ">Best, mean over seeds", ">Steps (M)", ">Training of all seeds (s)"), rows)


def budgets() -> str:
    """Mean returns of the evaluations during training after equal steps, and of the final policies."""
    steps = ("1M steps", "5M steps")
    rows = []
    for (task, algorithm), same in _blocks():
        reached = at_budgets(same)
        final = format_score(float(np.mean(_means(same, FINAL))))
        rows.append([task, shown_algorithm(algorithm), *(reached[title] for title in steps), final, _millions(same[0])])
    titles = [f">After {title}" for title in steps]
    return table(("Task", "Algorithm", *titles, ">Final", ">Steps of the final (M)"), rows)


def _blocks() -> list[tuple[tuple[str, str], list[LoggedRun]]]:
    """The runs of each task and algorithm."""
    grouped = itertools.groupby(runs(), key=lambda run: (run.task, run.config.algo.name))
    return [(key, list(same)) for key, same in grouped]


def _means(same: list[LoggedRun], policy: str) -> list[float]:
    return [run.score(policy)["mean"] for run in same]


def shown_algorithm(algorithm: str) -> str:
    """The name of an algorithm as tables show it."""
    return algorithm if algorithm == "csac" else algorithm.upper()


def _millions(run: LoggedRun) -> str:
    return f"{run.rows[-1]['env_steps'] / 1e6:.1f}"


def _seconds(run: LoggedRun) -> float:
    """Training time of all seeds of its process."""
    return run.rows[-1]["wall_seconds"] - _STOPPED_SECONDS.get((run.task, run.config.algo.name), 0)


def _in_csv(value: float) -> str:
    """A score as results.csv has it: whole numbers from 1,000 on."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.2f}"
