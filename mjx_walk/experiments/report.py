"""The report on runs of one or several environments: a figure, Markdown tables and a CSV file."""

from collections import defaultdict
from pathlib import Path

import numpy as np
import scipy.stats

from mjx_walk.experiments.budgets import at_budgets
from mjx_walk.experiments.curves import draw_suite, draw_task
from mjx_walk.experiments.logged_runs import MIN_SEEDS_FOR_IQM, LoggedRun, group, interval, read_runs
from mjx_walk.experiments.suite import REFERENCES, normalize
from mjx_walk.logs.metrics import write_csv
from mjx_walk.storage.files import write_text
from mjx_walk.storage.scores import BEST, FINAL
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import format_score, in_markdown
from mjx_walk.viewing.figures import standard_style

__all__ = ["write_report"]

_LEGEND = (
    "Scores are mean returns in Gymnasium. The final policy is the newest one. The best policy has the highest "
    "evaluation during training. In files from older versions, it is the better of the two on the scored episodes. "
    "The last table interpolates the evaluations during training, and takes the mean over the seeds. Its seconds are "
    "those of training.\n"
)
_NORMALIZED = (
    "A normalized score is 0 for uniformly random actions and 1 for the highest mean that SLM-Lab 5 has published for "
    "PPO, SAC and CrossQ on the same environment. Mean and IQM (interquartile mean) are taken over the environments, "
    "for each seed that is scored in all of them, and averaged over these seeds. Intervals are Student's 95% intervals "
    "over these seeds, given for three or more.\n"
)
_MIN_ENVIRONMENTS_FOR_IQM = 4
"""With fewer, an interquartile mean leaves nothing out."""
Tasks = dict[str, dict[str, list[LoggedRun]]]
"""Runs by environment and label."""


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
    task_cells = {task: {"task": task} if len(tasks) > 1 else {} for task in tasks}
    runs = [(task, name, run) for task, groups in tasks.items() for name, same in groups.items() for run in same]
    cells = [task_cells[task] | _run_cells(name, run) for task, name, run in runs]
    rows = [task_cells[task] | _csv_row(name, run) for task, name, run in runs]
    path = folder / "comparison.md"
    try:
        if len(tasks) > 1:
            draw_suite(tasks, folder / "comparison.png")
            tables, notes = [_aggregates(tasks), _task_summaries(tasks)], [_LEGEND, _NORMALIZED]
        else:
            (groups,) = tasks.values()
            draw_task(groups, folder / "comparison.png")
            tables, notes = [_summaries(groups)], [_LEGEND]
        budgets = [
            task_cells[task] | {"variant": name} | at_budgets(same)
            for task, groups in tasks.items()
            for name, same in groups.items()
        ]
        write_csv(rows, folder / "comparison.csv")
        write_text(path, "\n".join([*map(_table, [*tables, cells, budgets]), *notes]))
    except OSError as error:
        raise UserError(f"cannot write to '{folder}': {error.strerror}") from error
    return path


def _table(rows: list[dict[str, str]]) -> str:
    """A Markdown table of at least one row; all rows have the same columns. Cells may hold text of strangers."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(map(in_markdown, row.values()) for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _summaries(groups: dict[str, list[LoggedRun]]) -> list[dict[str, str]]:
    """Two rows per group, for the final and for the best policy."""
    return [_summary(name, runs, policy) for name, runs in groups.items() for policy in (FINAL, BEST)]


def _summary(variant: str, runs: list[LoggedRun], policy: str) -> dict[str, str]:
    scores = _scores_of(runs, policy)
    mean, std, low, high = _statistics(scores)
    return {
        "variant": variant,
        "policy": policy,
        "score": mean,
        "std over seeds": std,
        "lowest seed": _lowest(scores),
        "95% interval, low": low,
        "95% interval, high": high,
        "IQM": format_score(scipy.stats.trim_mean(scores, 0.25) if len(scores) >= MIN_SEEDS_FOR_IQM else None),
        "seeds scored": str(len(scores)),
        **_costs(runs),
    }


def _scores_of(runs: list[LoggedRun], policy: str) -> np.ndarray:
    """Scores of the runs whose policy was scored, `[N] f64`."""
    return np.array([run.score(policy)["mean"] for run in runs if run.score(policy)])


def _statistics(scores: np.ndarray) -> list[str]:
    """Mean, sample standard deviation and Student's 95% interval of `[N]` scores, as cells; dashes for too few."""
    mean = scores.mean() if len(scores) else None
    std = scores.std(ddof=1) if len(scores) > 1 else None
    return [format_score(value) for value in (mean, std, *(interval(scores) or (None, None)))]


def _lowest(scores: np.ndarray) -> str:
    """The cell of the lowest of `[N]` scores; a dash for none."""
    return format_score(scores.min() if len(scores) else None)


def _costs(runs: list[LoggedRun]) -> dict[str, str]:
    """Cells about the number of runs and their mean steps and seconds, by column."""
    return {
        "seeds": str(len(runs)),
        "million steps": f"{np.mean([run.rows[-1]['env_steps'] for run in runs]) / 1e6:,.2f}",
        "seconds": f"{np.mean([run.rows[-1]['wall_seconds'] for run in runs]):,.0f}",
    }


def _run_cells(variant: str, run: LoggedRun) -> dict[str, str]:
    """Cells about one run, by column."""
    final, best, last = run.score(FINAL), run.score(BEST), run.rows[-1]
    return {
        "variant": variant,
        "seed": str(run.config.seed),
        "final": format_score(final.get("mean")),
        "std over episodes": format_score(final.get("std")),
        "best": format_score(best.get("mean")),
        "its std over episodes": format_score(best.get("std")),
        "million steps": f"{last['env_steps'] / 1e6:,.2f}",
        "seconds": f"{last['wall_seconds']:,.0f}",
        "seeds in its process": f"{run.seeds_together:,.0f}",
    }


def _csv_row(variant: str, run: LoggedRun) -> dict[str, object]:
    """Values about one run, by column."""
    last = run.rows[-1]
    scores = {f"{policy}_{name}": run.score(policy).get(name) for policy in (FINAL, BEST) for name in ("mean", "std")}
    return {
        "variant": variant,
        "seed": run.config.seed,
        **scores,
        "env_steps": last["env_steps"],
        "wall_seconds": last["wall_seconds"],
        "seeds_together": run.seeds_together,
        "run_dir": run.config.run_dir,
    }


def _has_reference(task: str, runs: list[LoggedRun]) -> bool:
    """Whether the runs are scored in the environment that the references are of."""
    return task in REFERENCES and all(run.is_standard for run in runs)


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
        mean, _, low, high = _statistics(values)
        cells |= {f"normalized, {title}": mean, f"{title}, 95% low": low, f"{title}, 95% high": high}
    return cells | {"environments": str(len(known)), "seeds scored in all": str(len(complete))}


def _task_summaries(tasks: Tasks) -> list[dict[str, str]]:
    """One row per environment and label."""
    return [_task_summary(task, name, runs) for task, groups in tasks.items() for name, runs in groups.items()]


def _task_summary(task: str, name: str, runs: list[LoggedRun]) -> dict[str, str]:
    final, best = (_scores_of(runs, policy) for policy in (FINAL, BEST))
    random, reference = REFERENCES[task] if _has_reference(task, runs) else (None, None)
    mean, std, low, high = _statistics(final)
    return {
        "task": task,
        "variant": name,
        "final": mean,
        "std over seeds": std,
        "lowest seed": _lowest(final),
        "95% low": low,
        "95% high": high,
        "best": _statistics(best)[0],
        "random": format_score(random),
        "reference": format_score(reference),
        "final, normalized": format_score(normalize(task, final.mean()) if reference and len(final) else None),
        "best, normalized": format_score(normalize(task, best.mean()) if reference and len(best) else None),
        **_costs(runs),
    }
