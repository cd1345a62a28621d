"""How Optuna chooses the values of a trial, and which trials end early."""

import importlib
import warnings
from typing import TYPE_CHECKING

import numpy as np

from mjx_walk.experiments.search_space import Choices, SearchSpace

if TYPE_CHECKING:
    import optuna

__all__ = ["PRUNERS", "SAMPLERS", "TICKS", "make_pruner", "make_sampler", "with_values"]

TICKS = 20
"""Equal parts of a training. After each of them, a trial reports a value, and may be pruned."""
SAMPLERS = ("tpe", "random")
PRUNERS = ("median", "halving", "hyperband", "none")
_TRIALS_WITHOUT_PRUNING = 5


def with_values(trial: "optuna.Trial", space: SearchSpace) -> "optuna.Trial":
    """A trial with a value for each setting. A kill may have left it without some of them."""
    for key, values in space.ranges.items():
        if trial.number == 0 and key not in space.recipe_values:
            continue
        if isinstance(values, Choices):
            trial.suggest_categorical(key, values.labels)
        elif values.is_int:
            trial.suggest_int(key, int(values.low), int(values.high), log=values.is_log)
        else:
            trial.suggest_float(key, values.low, values.high, log=values.is_log)
    return trial


def make_sampler(name: str, seed: int, number: int) -> "optuna.samplers.BaseSampler":
    """A sampler for one trial. Its seed depends on the trial's number, so that a resumed study repeats no trial."""
    samplers = importlib.import_module("optuna.samplers")
    own_seed = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
    return {"tpe": samplers.TPESampler, "random": samplers.RandomSampler}[name](seed=own_seed)


def make_pruner(name: str) -> "optuna.pruners.BasePruner":
    """One of `PRUNERS`, for `TICKS` values of each trial."""
    from optuna import pruners

    if name == "median":
        return pruners.MedianPruner(n_startup_trials=_TRIALS_WITHOUT_PRUNING, n_warmup_steps=TICKS // 4)
    if name == "halving":
        return pruners.SuccessiveHalvingPruner(min_resource=TICKS // 10, reduction_factor=3)
    if name == "hyperband":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return pruners.HyperbandPruner(min_resource=TICKS // 10, max_resource=TICKS, reduction_factor=3)
    return pruners.NopPruner()
