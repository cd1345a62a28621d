"""Runs of several environments: scores normalized for each, aggregates over all, and one figure."""

import math
from collections import defaultdict
from pathlib import Path

import matplotlib.figure
import numpy as np
import scipy.stats

from mjx_walk.envs import BUILT_IN_TASKS
from mjx_walk.experiments import planned_runs
from mjx_walk.experiments.logged_runs import LoggedRun, group, interval, read_runs
from mjx_walk.experiments.planned_runs import PlannedRun
from mjx_walk.experiments.report import DRAWN, LEGEND, csv_row, draw_curves, run_cells, table, write_comparison
from mjx_walk.logs.metrics import write_csv
from mjx_walk.storage.files import refuse_links, replacing, user_path, write_text
from mjx_walk.storage.scores import BEST, FINAL
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import format_score
from mjx_walk.viewing.figures import standard_style
from mjx_walk.viewing.run_plots import THOUSANDS

__all__ = ["REFERENCES", "SUITES", "Tasks", "normalize", "plan_suite", "write_report"]

SUITES = {"mujoco": tuple(BUILT_IN_TASKS)}
"""Environments of each suite."""

REFERENCES = {
    "Humanoid-v5": (110, 3_774),
    "HumanoidStandup-v5": (33_501, 165_841),
    "Walker2d-v5": (1.93, 4_390),
    "Ant-v5": (-78.2, 4_943),
    "HalfCheetah-v5": (-281, 9_815),
    "Hopper-v5": (17.0, 1_972),
    "Swimmer-v5": (3.16, 301),
    "Reacher-v5": (-42.9, -5.03),
    "Pusher-v5": (-148, -37.1),
    "InvertedPendulum-v5": (5.63, 950),
    "InvertedDoublePendulum-v5": (50.1, 9_033),
}
"""For each environment, the score of uniformly random actions over 100 episodes, and the highest mean of four seeds
that SLM-Lab 5 has published for PPO, SAC and CrossQ on the same environment: an average of training returns.

Later reruns of SLM-Lab are lower. docs/published.csv has the source of each mean."""

_COLUMNS = 4
_MIN_ENVIRONMENTS_FOR_IQM = 4
"""With fewer, an interquartile mean leaves nothing out."""


def plan_suite(
    suite: str, overrides: list[str], algos: list[str], seeds: list[int], out: str | None, hardware: str
) -> tuple[Path, list[PlannedRun]]:
    """Plan the runs of a suite, as `planned_runs.plan` does for each environment, in a folder for each.

    Raises:
        UserError: an override of the environment, or any run has an invalid setting.
    """
    for override in overrides:
        if override.partition("=")[0] in ("env", "env.name"):
            raise UserError(f"'{override}': suite={suite} has its own environments; leave out one of the two")
    folder = user_path(out or f"runs/compare_{suite}")
    runs = []
    for env in SUITES[suite]:
        refuse_links(folder / env, folder)
        _, planned = planned_runs.plan([f"env={env}", *overrides], algos, seeds, str(folder / env), hardware)
        runs += [PlannedRun(f"{env}/{run.variant}", run.overrides, run.config) for run in planned]
    return folder, runs


@standard_style()
def write_report(folder: Path) -> Path:
    """Write `comparison.png`, `comparison.md` and `comparison.csv` about all runs below a folder.

    Returns:
        The Markdown file.

    Raises:
        UserError: there are no runs, one holds links or pipes, or the folder cannot be written to.
    """
    by_task = defaultdict(list)
    for run in read_runs(folder):
        by_task[run.task].append(run)
    ordered = sorted(by_task, key=lambda task: ([*REFERENCES, task].index(task), task))
    tasks = {task: group(by_task[task]) for task in ordered}
    path = folder / "comparison.md"
    try:
        if len(tasks) == 1:
            return write_comparison(folder, *tasks.values())
        _draw(tasks, folder / "comparison.png")
        rows = [(task, name, run) for task, groups in tasks.items() for name, runs in groups.items() for run in runs]
        write_csv([{"task": task} | csv_row(name, run) for task, name, run in rows], folder / "comparison.csv")
        parts = [table(_aggregates(tasks)), table(_summaries(tasks))]
        parts.append(table([{"task": task} | run_cells(name, run) for task, name, run in rows]))
        write_text(path, "\n".join([*parts, LEGEND, _NORMALIZED]))
    except OSError as error:
        raise UserError(f"cannot write to '{folder}': {error.strerror}") from error
    return path


_NORMALIZED = (
    "A normalized score is 0 for uniformly random actions and 1 for the highest mean that SLM-Lab 5 has published for "
    "PPO, SAC and CrossQ on the same environment. Mean and IQM (interquartile mean) are taken over the environments, "
    "for each seed that is scored in all of them, and averaged over these seeds. Intervals are Student's 95% intervals "
    "over these seeds, given for three or more.\n"
)


def normalize(task: str, score: float) -> float:
    """0 for random actions, 1 for the reference."""
    random, reference = REFERENCES[task]
    return (score - random) / (reference - random)


def _has_reference(task: str, runs: list[LoggedRun]) -> bool:
    """Whether the runs are scored in the environment that the references are of."""
    return task in REFERENCES and all(run.is_standard for run in runs)


Tasks = dict[str, dict[str, list[LoggedRun]]]
"""Runs by environment and label."""


def _aggregates(tasks: Tasks) -> list[dict[str, str]]:
    """Two rows per label: normalized scores over all environments that have a reference."""
    labels = dict.fromkeys(name for groups in tasks.values() for name in groups)
    return [_aggregate(tasks, name, policy) for name in labels for policy in (FINAL, BEST)]


def _aggregate(tasks: Tasks, name: str, policy: str) -> dict[str, str]:
    scores: defaultdict[int, list[float]] = defaultdict(list)
    known = [task for task, groups in tasks.items() if name in groups and _has_reference(task, groups[name])]
    for task in known:
        for run in tasks[task][name]:
            if run.score(policy):
                scores[run.config.seed].append(normalize(task, run.score(policy)["mean"]))
    complete = [values for values in scores.values() if len(values) == len(known)]
    means = np.mean(complete, axis=1) if complete else np.zeros(0)
    has_iqm = complete and len(known) >= _MIN_ENVIRONMENTS_FOR_IQM
    iqms = scipy.stats.trim_mean(complete, 0.25, axis=1) if has_iqm else np.zeros(0)
    cells = {"variant": name, "policy": policy}
    for title, values in (("mean", means), ("IQM", iqms)):
        low, high = interval(values) or (None, None)
        cells |= {
            f"normalized, {title}": format_score(values.mean() if len(values) else None),
            f"{title}, 95% low": format_score(low),
            f"{title}, 95% high": format_score(high),
        }
    return cells | {"environments": str(len(known)), "seeds scored in all": str(len(complete))}


def _summaries(tasks: Tasks) -> list[dict[str, str]]:
    """One row per environment and label."""
    return [_summary(task, name, runs) for task, groups in tasks.items() for name, runs in groups.items()]


def _summary(task: str, name: str, runs: list[LoggedRun]) -> dict[str, str]:
    final, best = (
        np.array([run.score(policy)["mean"] for run in runs if run.score(policy)]) for policy in (FINAL, BEST)
    )
    random, reference = REFERENCES[task] if _has_reference(task, runs) else (None, None)
    low, high = interval(final) or (None, None)
    return {
        "task": task,
        "variant": name,
        "final": format_score(final.mean() if len(final) else None),
        "std over seeds": format_score(final.std(ddof=1) if len(final) > 1 else None),
        "95% low": format_score(low),
        "95% high": format_score(high),
        "best": format_score(best.mean() if len(best) else None),
        "random": format_score(random),
        "reference": format_score(reference),
        "final, normalized": format_score(normalize(task, final.mean()) if reference and len(final) else None),
        "best, normalized": format_score(normalize(task, best.mean()) if reference and len(best) else None),
        "seeds": str(len(runs)),
        "million steps": f"{np.mean([run.rows[-1]['env_steps'] for run in runs]) / 1e6:,.2f}",
        "seconds": f"{np.mean([run.rows[-1]['wall_seconds'] for run in runs]):,.0f}",
    }


def _draw(tasks: Tasks, path: Path) -> None:
    """One plot per environment, and the legend in the plot that is left, or below."""
    num_rows = math.ceil(len(tasks) / _COLUMNS)
    figure = matplotlib.figure.Figure(figsize=(3.6 * _COLUMNS, 2.7 * num_rows), layout="constrained")
    panels = figure.subplots(num_rows, _COLUMNS, squeeze=False).ravel()
    for axes, (task, groups) in zip(panels, tasks.items(), strict=False):
        draw_curves(axes, groups, "return", "env_steps", 1e6)
        if task in REFERENCES:
            axes.axhline(REFERENCES[task][1], color="0.4", linewidth=1, linestyle=":", label="reference")
        axes.set_title(task, fontsize=10)
        axes.yaxis.set_major_formatter(THOUSANDS)
        axes.grid(alpha=0.3)
    for axes in panels[len(tasks) :]:
        axes.axis("off")
    for axes in panels[: len(tasks)][-_COLUMNS:]:
        axes.set_xlabel("million environment steps")
    figure.suptitle(f"Returns. {DRAWN}", fontsize=11)
    handles = {
        label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize=9)
    with replacing(path) as new:
        figure.savefig(new, dpi=110)
