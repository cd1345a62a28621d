"""Tables of the seeds that no recipe was tuned on, and of the search for PPO's recipe, from experiments.csv."""

import scipy.stats

from generator.markdown import table
from generator.score_tables import number, read

_CSAC = ("LP1", "LP3")
"""Arms of csac, one for each task."""
_OTHERS = {
    "LP4": "PPO, 55.1M steps",
    "LP5": "SAC",
    "LP7": "A2C",
    "LP6": "TD3",
    "LP8": "DDPG",
    "LP18": "TD3",
    "LP17": "SAC",
    "LP9": "PPO, 45.9M steps",
    "LP10": "PPO, 140.5M steps",
    "LP21": "A2C, 110.1M steps",
    "LP20": "A2C",
    "LP11": "TD3",
    "LP19": "SAC",
    "LP12": "DDPG",
}
"""Arms of the other algorithms, with the words of the table."""
_PPO = ("EC4", "EC13", "PT1", "EB5", "EC1", "EB11", "EC2", "ED5")
"""Arms of PPO with the settings of the present recipes."""
_SIX = {"AH14": "A2C", "H24": "PPO", "SH27": "SAC", "TH5": "TD3", "DH3": "DDPG", "RH12": "REINFORCE"}
"""Arms of six algorithms on Humanoid, with seeds 0 to 2."""

Row = dict[str, str]


def csac_seeds() -> str:
    """The final and the best policy of every seed of csac."""
    log, rows = _log(), []
    for arm in _CSAC:
        for seed in log[arm]["seeds"].split():
            final, best = log[f"{arm}.s{seed}"], log[f"{arm}.s{seed}@best"]
            scores = [_round(row[key]) for row in (final, best) for key in ("final_mean", "std")]
            rows.append([final["task"], seed, *scores, _millions(best)])
    titles = ("Task (v5)", ">Seed", ">Final", ">Std", ">Best", ">Its std", ">Best policy's step (M)")
    return table(titles, rows)


def csac_means() -> str:
    """The means of csac over seeds."""
    log, rows = _log(), []
    for arm in _CSAC:
        final, best = log[arm], log[f"{arm}@best"]
        cells = [_round(final["final_mean"]), _round(final["std"]), *_interval(final)]
        rows.append([final["task"], *cells, _round(best["final_mean"]), _round(best["std"])])
    titles = ("Task (v5)", ">Final, mean over seeds", ">Std over seeds", ">Interval from", ">Interval to")
    return table((*titles, ">Best, mean over seeds", ">Std over seeds"), rows)


def other_algorithms() -> str:
    """The final policies of the other algorithms."""
    log, rows = _log(), []
    for arm, algorithm in _OTHERS.items():
        row = log[arm]
        seeds = [_round(log[f"{arm}.s{seed}"]["final_mean"]) for seed in row["seeds"].split()]
        rows.append([row["task"], algorithm, *seeds, _round(row["final_mean"]), _round(row["std"]), *_interval(row)])
    titles = ("Task (v5)", "Algorithm", ">Seed 100", ">Seed 101", ">Seed 102", ">Mean", ">Std")
    return table((*titles, ">Interval from", ">Interval to"), rows)


def six_algorithms() -> str:
    """The better of the final and the best policy of six algorithms."""
    log, rows = _log(), []
    for arm, algorithm in _SIX.items():
        row = log[arm]
        lowest = min(float(log[f"{arm}.s{seed}"]["final_mean"]) for seed in row["seeds"].split())
        cells = [_round(row["final_mean"]), _round(row["std"]), _round(str(lowest)), _millions(row), row["seconds"]]
        rows.append([algorithm, *cells])
    titles = ("Algorithm", ">Mean score", ">Std", ">Lowest seed", ">Steps (M)", ">Training of all three (s)")
    return table(titles, rows)


def ppo_on_other_tasks() -> str:
    """Seeds of the search for PPO's recipe."""
    log, rows = _log(), []
    for arm in _PPO:
        row = log[arm]
        rows.append([f"{row['task']}-v5", row["seeds"], number(row["final_mean"]), number(row["std"]), _millions(row)])
    return table(("Task", ">Seed", ">Score", ">Std", ">Steps (M)"), rows)


def _log() -> dict[str, Row]:
    """The scores in Gymnasium by the id of their arm."""
    return {row["id"]: row for row in read("experiments.csv") if row["measure"] == "gymnasium"}


def _round(text: str) -> str:
    return f"{float(text):,.0f}"


def _millions(row: Row) -> str:
    return f"{int(row['steps']) / 1e6:.1f}"


def _interval(row: Row) -> list[str]:
    """Student's 95% interval of a mean over seeds."""
    num_seeds = len(row["seeds"].split())
    half = scipy.stats.t.ppf(0.975, num_seeds - 1) * float(row["std"]) / num_seeds**0.5
    return [f"{float(row['final_mean']) + sign * half:,.0f}" for sign in (-1, 1)]
