"""Command: every feature of `feature_models`, alone and with others, on an MJX engine against the `c` engine.

    python tests/model_features.py --engines jax --settings no_damper --groups joint tendon --pairs

A setting is an option or a flag. Each run is a world with one setting, where many small models with one feature (with
`--pairs`: with two) stand apart. What differs there is tried alone, because the models of a world share one solver.
A case is `equal`, `differs`, `refused` in one line, an `error`, or `invalid`: MuJoCo refuses the model. It prints what
differs and a table of counts, and exits with code 1 if a case differs or fails.
"""

import argparse
import collections
import itertools
import os
import sys
from collections.abc import Iterator
from typing import NamedTuple

import feature_models
import jax
import mujoco
import numpy as np
from feature_models import Features
from features import FEATURES, FLAGS, GROUPS, OPTIONS
from trajectories import visited_states
from xla_flags import quick_compile

from mjx_walk.envs.physics import make_engine, mjx_model
from mjx_walk.envs.physics.supported import refuse_unsupported
from mjx_walk.utils.errors import UserError

NUM_SUBSTEPS = 4
LARGEST_ERROR = 2e-3
"""Of velocities, relative to one plus their change; 90% of the states may not exceed it."""


class Case(NamedTuple):
    """One model on one engine."""

    engine: str
    integrator: str
    features: Features


class Outcome(NamedTuple):
    """What an engine makes of it."""

    kind: str
    detail: str = ""


def errors(model: mujoco.MjModel, engine: str, owners: list[int]) -> list[np.ndarray]:
    """Errors of velocities after a step, relative to one plus the change of the exhibit's fastest.

    Args:
        model: a gallery.
        engine: to compare with `c`.
        owners: the exhibit of each degree of freedom.

    Returns:
        For each exhibit, the largest error in each visited state.
    """
    states, controls = visited_states(model, num_envs=8, num_steps=3)
    expected, found = (
        np.asarray(jax.jit(jax.vmap(make_engine(one, model, NUM_SUBSTEPS, ()).step))(states, controls)[0].qvel)
        for one in ("c", engine)
    )
    by_exhibit = []
    for exhibit in range(max(owners) + 1):
        own = np.array(owners) == exhibit
        change = np.abs(expected - states.qvel)[:, own].max(axis=1)
        by_exhibit.append(np.abs(found - expected)[:, own].max(axis=1) / (1 + change))
    return by_exhibit


def options(integrator: str, features: Features) -> str:
    """Attributes of a world's `option`, less those that a feature gives itself."""
    given = {"integrator": integrator, "jacobian": "dense"}
    text = " ".join(FEATURES[name].get("option", "") for name in features)
    return " ".join(f'{name}="{value}"' for name, value in given.items() if f'{name}="' not in text)


def refusal(case: Case, settings: Features) -> Outcome | None:
    """The outcome of a case that needs no simulation."""
    everything = (*settings, *case.features)
    try:
        model = feature_models.load(*everything, option=options(case.integrator, everything))
    except ValueError as error:
        return Outcome("invalid", str(error).splitlines()[0])
    try:
        refuse_unsupported(model, case.engine)
    except UserError as error:
        return Outcome("error" if "\n" in str(error) else "refused", str(error))
    return None


def outcomes(cases: list[Case], settings: Features) -> Iterator[tuple[Case, Outcome]]:
    """Outcomes of cases of one engine and integrator, with the same settings."""
    rest = []
    for case in cases:
        refused = refusal(case, settings)
        if refused:
            yield case, refused
        else:
            rest.append(case)
    if rest:
        yield from _simulated(rest, settings)


def _simulated(cases: list[Case], settings: Features) -> Iterator[tuple[Case, Outcome]]:
    engine, integrator, _ = cases[0]
    size = 10 if engine == "warp" else 31
    shared = [case for case in cases if feature_models.is_local(case.features)]
    rooms = [shared[i : i + size] for i in range(0, len(shared), size)]
    for room in [*rooms, *([case] for case in cases if case not in shared)]:
        if room[0] in shared:
            option = options(integrator, settings)
            model = feature_models.gallery([case.features for case in room], settings, option=option)
            owners = feature_models.exhibit_of_dofs(model)
        else:
            everything = (*settings, *room[0].features)
            model = feature_models.load(*everything, option=options(integrator, everything))
            owners = [0] * model.nv
        try:
            found = errors(model, engine, owners)
        except Exception as error:
            if len(room) > 1:
                half = len(room) // 2
                yield from _simulated(room[:half], settings)
                yield from _simulated(room[half:], settings)
                continue
            kind = "refused" if isinstance(error, UserError) and "\n" not in str(error) else "error"
            yield room[0], Outcome(kind, f"{type(error).__name__}: {str(error)[:200]}")
            continue
        finally:
            jax.clear_caches()
        for case, each in zip(room, found, strict=True):
            quantiles = np.quantile(each, (0.5, 0.9, 1.0))
            is_equal = quantiles[1] < LARGEST_ERROR  # false for NaN
            if not is_equal and len(room) > 1:
                yield from _simulated([case], settings)
                continue
            text = "median {:.1e}, 90% {:.1e}, largest {:.1e}".format(*quantiles)
            yield case, Outcome("equal" if is_equal else "differs", text)


def compile_quickly() -> None:
    """Tell XLA to compile quickly, on the CPU unless the user chooses."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ["XLA_FLAGS"] = f"{quick_compile(0)} {os.environ.get('XLA_FLAGS', '')}"


def let_solver_converge() -> None:
    """Give MJX's solver and Warp's buffers what a world of many models needs."""
    mjx_model.MIN_SOLVER_ITERATIONS = 60
    try:
        from mjx_walk.envs.physics import mjx_warp
    except ImportError:
        return
    mjx_warp.CONTACTS_PER_ENV, mjx_warp.CONSTRAINTS_PER_ENV = 200, 800


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engines", nargs="+", default=["jax", "warp"])
    parser.add_argument("--integrators", nargs="+", default=["Euler", "RK4", "implicitfast"])
    parser.add_argument("--settings", nargs="+", default=["none"], help="such as no_spring+no_damper, none, or all")
    parser.add_argument("--groups", nargs="+", default=[*GROUPS], help="of features")
    parser.add_argument("--features", nargs="+", help="instead of groups")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--verbose", action="store_true", help="print every case")
    given = parser.parse_args()
    compile_quickly()
    let_solver_converge()
    names = given.features or [
        name for group in given.groups if group not in ("flag", "option") for name in GROUPS[group]
    ]
    sets = [*itertools.combinations(names, 2)] if given.pairs else [(name,) for name in names]
    settings = given.settings
    if settings == ["all"]:
        settings = ["none", *FLAGS, *OPTIONS]
    counts: collections.Counter = collections.Counter()
    for setting, engine, integrator in itertools.product(settings, given.engines, given.integrators):
        cases = [Case(engine, integrator, each) for each in sets]
        for case, found in outcomes(cases, () if setting == "none" else tuple(setting.split("+"))):
            counts[engine, found.kind] += 1
            if given.verbose or found.kind in ("differs", "error"):
                named = " × ".join((setting, *case.features))
                print(f"{engine} {integrator} {named}: {found.kind} {found.detail}", flush=True)
    for (engine, kind), count in sorted(counts.items()):
        print(f"{engine}: {count} {kind}")
    return int(any(kind in ("differs", "error") for _, kind in counts))


if __name__ == "__main__":
    sys.exit(main())
