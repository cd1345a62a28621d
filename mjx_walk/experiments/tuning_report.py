"""The report on a study: a page with Optuna's figures, a table of trials, and the best trials as recipe files."""

import base64
import html
import io
import shlex
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from omegaconf import OmegaConf

from mjx_walk.algos import BUILT_IN_ALGORITHMS
from mjx_walk.envs import BUILT_IN_TASKS
from mjx_walk.experiments.study import Facts, StudyFolder
from mjx_walk.experiments.trial_values import NUM_EVALUATIONS
from mjx_walk.logs.metrics import write_csv
from mjx_walk.storage.files import write_text
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import format_score, printable
from mjx_walk.viewing.figures import standard_style

if TYPE_CHECKING:
    import optuna

__all__ = ["ranked", "summary", "write_page", "write_tables"]

_NUM_RECIPES = 3
_NUM_SEEDS = 5
"""Fresh seeds of the comparison that the report proposes."""
_MOST_ROWS = 20
_DPI = 80
_SIZE = (9.0, 4.5)
"""Inches of a figure."""
_MOST_LABELS = 12
"""Entries of a legend; one of more would be taller than its figure."""
_VALUE = f"mean return of the last {NUM_EVALUATIONS} evaluations"
_FIGURES: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
    (
        "Values",
        f"A dot for each complete trial: its {_VALUE}. Line: the best so far.",
        "plot_optimization_history",
        {"target_name": "return"},
    ),
    (
        "Learning curves",
        "The value after each twentieth of the training. Pruned trials end early.",
        "plot_intermediate_values",
        {},
    ),
    (
        "Importance",
        "Importance of each setting for reaching good values (PED-ANOVA). It says little for few trials.",
        "plot_param_importances",
        {"params": None, "target_name": "return"},
    ),
    (
        "Settings",
        "The value against each setting. Later trials are darker.",
        "plot_slice",
        {"params": None, "target_name": "return", "size": (6.0, 4.0)},
    ),
    (
        "Combinations",
        "A line for each complete trial. Better ones are darker.",
        "plot_parallel_coordinate",
        {"params": None, "target_name": "return", "size": (13.0, 5.0)},
    ),
)
"""Title, explanation, name and options of each of Optuna's figures. `params` stands for the searched settings."""
_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:1200px;margin:2em auto;padding:0 1em}table{border-collapse:collapse}"
    "td,th{border-bottom:1px solid #ccc;padding:.2em .7em;text-align:right}img{max-width:100%}"
    "pre{background:#f4f4f4;padding:.7em;white-space:pre-wrap}tr.recipe{background:#fff3d6}"
)


def ranked(study: "optuna.Study") -> list["optuna.trial.FrozenTrial"]:
    """The complete trials, the best one first."""
    from optuna.trial import TrialState

    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return sorted(complete, key=lambda trial: -float(trial.value or 0.0))


def write_tables(folder: StudyFolder, study: "optuna.Study") -> None:
    """Write `trials.csv`, and the best trials as `best.yaml`, `best_2.yaml` and `best_3.yaml`.

    Raises:
        UserError: the folder cannot be written to.
    """
    facts = folder.facts(study)
    try:
        write_csv(
            [_row(folder, facts, trial) for trial in study.get_trials(deepcopy=False)], folder.path / "trials.csv"
        )
        for path, trial in zip(_recipe_files(folder), _distinct(study), strict=False):
            write_text(path, _recipe(facts, trial))
    except OSError as error:
        raise UserError(f"cannot write to {folder.path}: {error.strerror}") from error


def _distinct(study: "optuna.Study") -> list["optuna.trial.FrozenTrial"]:
    """The best complete trials whose values differ."""
    found: dict[str, optuna.trial.FrozenTrial] = {}
    for trial in ranked(study):
        found.setdefault(str(sorted(trial.params.items())), trial)
    return list(found.values())[:_NUM_RECIPES]


def _recipe_files(folder: StudyFolder) -> list[Path]:
    return [folder.path / ("best.yaml" if i == 1 else f"best_{i}.yaml") for i in range(1, _NUM_RECIPES + 1)]


def _row(folder: StudyFolder, facts: Facts, trial: "optuna.trial.FrozenTrial") -> dict[str, object]:
    """Values about one trial, by column."""
    own = {key: facts.settings.get(key) for key in facts.ranges}  # the recipe's, where the trial has none
    return {
        "trial": trial.number,
        "state": trial.state.name.lower(),
        "value": trial.value,
        **{key: str(value) for key, value in (own | trial.params).items()},
        "seconds": trial.user_attrs.get("seconds"),
        "reason": trial.user_attrs.get("reason"),
        "folder": str(folder.trial_folder(trial.number)),
    }


def _recipe(facts: Facts, trial: "optuna.trial.FrozenTrial") -> str:
    """A trial as a recipe file: the recipe of the study, the settings that the user gave, and the values found."""
    env, algo = str(facts.settings["env.name"]), str(facts.settings["algo.name"])
    defaults: list[object] = [facts.recipe]
    # Tasks and algorithms of the user are known only once their file has run.
    defaults += [{"override /env": env}] if env in BUILT_IN_TASKS else []
    defaults += [{"override /algo": algo}] if algo in BUILT_IN_ALGORITHMS else []
    node = OmegaConf.create({"defaults": [*defaults, "_self_"]})
    found = {key: yaml.safe_load(value) if isinstance(value, str) else value for key, value in trial.params.items()}
    for key, value in (facts.changes | found).items():
        OmegaConf.update(node, key, value)
    first = f"# Trial {trial.number}, seeds {facts.seeds}: {format_score(trial.value)}, the {_VALUE}.\n"
    return printable(first.rstrip()) + "\n" + OmegaConf.to_yaml(node)


def summary(folder: StudyFolder, study: "optuna.Study") -> str:
    """The result of a study in a few lines, with the commands for its best recipe."""
    from optuna.trial import TrialState

    states = [trial.state for trial in study.get_trials(deepcopy=False)]
    counts = (f"{states.count(state)} {state.name.lower()}" for state in TrialState if state in states)
    lines = [f"{len(states)} trials: {', '.join(counts)}"]
    best, facts = ranked(study), folder.facts(study)
    if not best:
        return lines[0]
    own = next((trial for trial in best if trial.number == 0), None)
    lines.append(f"Best: {format_score(best[0].value)} by trial {best[0].number}. Values are the {_VALUE}.")
    if own is best[0]:
        return "\n".join(map(printable, [*lines, "This is the recipe with your settings. No trial beats it: keep it."]))
    if own:
        lines.append(f"The recipe with your settings, trial 0: {format_score(own.value)}.")
    lines += [f"  {key}={value}" for key, value in best[0].params.items()]
    lines += ["", "Train with the best:", f"  {_train_command(folder, facts)}"]
    lines += ["One seed is no result. Compare the best trials with the recipe on fresh seeds:"]
    lines += [f"  {_compare_command(folder, facts, len(_distinct(study)))}"]
    return "\n".join(map(printable, lines))


def _train_command(folder: StudyFolder, facts: Facts) -> str:
    return f"python -m mjx_walk.train {shlex.join([*facts.chosen, f'recipe={_recipe_files(folder)[0]}'])}"


def _compare_command(folder: StudyFolder, facts: Facts, num_recipes: int) -> str:
    first = max(facts.seeds) + 1
    files = [facts.recipe, *map(str, _recipe_files(folder)[:num_recipes])]
    words = [word for word in facts.chosen if not word.startswith("algo=")]
    words += [f"algos=[{facts.settings['algo.name']}]", f"recipe={','.join(files)}"]
    words += [f"{key}={_word(value)}" for key, value in facts.changes.items()]
    seeds = ",".join(map(str, range(first, first + _NUM_SEEDS)))
    return f"python -m mjx_walk.compare {shlex.join([*words, f'seeds=[{seeds}]'])}"


def _word(value: object) -> str:
    """A value as a command line has it."""
    if isinstance(value, list):
        return f"[{','.join(map(_word, value))}]"
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))


def write_page(folder: StudyFolder, study: "optuna.Study") -> Path:
    """Write `report.html`, which has its figures inside. Returns its path.

    Raises:
        UserError: the folder cannot be written to.
    """
    facts = folder.facts(study)
    rows = [_row(folder, facts, trial) for trial in _by_value(study)[:_MOST_ROWS]]
    title = html.escape(f"Study of {facts.settings['env.name']} with {facts.settings['algo.name']}")
    parts = [f"<h1>{title}</h1><pre>{html.escape(summary(folder, study))}</pre>"]
    parts += [f"<h2>{name}</h2><p>{text}</p>{image}" for name, text, image in _figures(study, facts)]
    parts += [f"<h2>Best trials</h2>{_table(rows, facts)}{_failures(study)}"]
    page = f"<!doctype html><meta charset=utf-8><title>{title}</title><style>{_STYLE}</style>{''.join(parts)}\n"
    path = folder.path / "report.html"
    try:
        write_text(path, page)
    except OSError as error:
        raise UserError(f"cannot write to {folder.path}: {error.strerror}") from error
    return path


def _by_value(study: "optuna.Study") -> list["optuna.trial.FrozenTrial"]:
    """Complete trials from the best one on, then the others."""
    complete = ranked(study)
    return [*complete, *(trial for trial in study.get_trials(deepcopy=False) if trial not in complete)]


def _table(rows: list[dict[str, object]], facts: Facts) -> str:
    names = ["trial", "state", "value", *facts.ranges, "seconds"]
    titles = "".join(f"<th>{html.escape(name.removeprefix('algo.'))}</th>" for name in names)
    lines = [f"<tr>{titles}</tr>"]
    for row in rows:
        cells = "".join(f"<td>{html.escape(_cell(row[name]))}</td>" for name in names)
        lines.append(f"<tr{' class=recipe' if row['trial'] == 0 else ''}>{cells}</tr>")
    return f"<table>{''.join(lines)}</table><p>Coloured: the values of the recipe.</p>"


def _failures(study: "optuna.Study") -> str:
    """A line for each trial that has failed."""
    reasons = ((trial.number, trial.user_attrs.get("reason")) for trial in study.get_trials(deepcopy=False))
    lines = [f"<li>Trial {number}: {html.escape(str(reason))}</li>" for number, reason in reasons if reason]
    return f"<h2>Failures</h2><ul>{''.join(lines)}</ul>" if lines else ""


def _cell(value: object) -> str:
    try:
        return "" if value is None else f"{float(str(value)):.4g}"
    except ValueError:
        return str(value)


@standard_style()
def _figures(study: "optuna.Study", facts: Facts) -> list[tuple[str, str, str]]:
    """Title, explanation and image of each figure that the study has enough trials for."""
    import matplotlib.pyplot as plt
    from optuna.visualization import matplotlib as optuna_figures

    plt.switch_backend("agg")  # Optuna draws with pyplot, which would ask for a screen
    ranges, found = list(facts.ranges), []
    for title, text, name, options in _FIGURES:
        options = options | ({"params": ranges} if "params" in options else {})
        style: dict[Any, Any] = {"figure.figsize": options.pop("size", _SIZE), "text.parse_math": True}
        with warnings.catch_warnings(), plt.rc_context(style):
            warnings.simplefilter("ignore")  # Optuna calls its figures experimental
            try:
                axes = getattr(optuna_figures, name)(study, **options)
                found.append((title, text, _image(axes)))
            except (ValueError, RuntimeError, LookupError):  # too few trials
                continue
            finally:
                plt.close("all")
    return found


def _image(axes: Any) -> str:
    """The figure of axes as an element of a page."""
    all_axes = axes.ravel() if isinstance(axes, np.ndarray) else [axes]
    figure = all_axes[0].figure
    for own in all_axes:
        own.set_title("")
        legend = own.get_legend()
        if legend and len(legend.get_texts()) > _MOST_LABELS:
            legend.remove()
    figure.suptitle("")
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=_DPI, bbox_inches="tight")
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}">'
