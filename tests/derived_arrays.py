"""Compare every array of `mjData` on every engine with MuJoCo's, at a reset and after a step.

    python tests/derived_arrays.py [--engines c jax warp] [--models NAME ...] [--alone]

It prints a table of arrays by engine and moment: equal, refused, or the largest error relative to the largest value.
It exits with code 1 if an array that is not refused differs.
The reference does what Gymnasium does: `mj_forward` at a reset; `mj_step`, then `mj_rnePostConstraint`, in a step.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich_model import ACTIVATION, FIXED, FORCE_SENSORS, NOT_ON_MJX, SENSORS, SPATIAL, SUBTREE_SENSORS, rich, sensors

from mjx_walk.envs import models
from mjx_walk.envs.physics import PhysicsState, make_engine
from mjx_walk.envs.physics.derived_arrays import LATE_ARRAYS, refuse_derived
from mjx_walk.machine.compat import prepare_jax
from mjx_walk.utils.errors import UserError

ENGINES = ("c", "jax", "warp")
MOMENTS = ("reset", "step")
NUM_SUBSTEPS = 2
TOLERANCE = {"c": 1e-6, "jax": 2e-3, "warp": 2e-3}
"""Largest error of an equal array, relative to its largest value. MJX computes in float32."""

MODELS: dict[str, Callable[[], mujoco.MjModel]] = {
    "half_cheetah": lambda: models.load_model("half_cheetah.xml"),
    "humanoid": lambda: models.load_model("humanoid.xml"),
    "air": lambda: rich(height=2),
    "floor": rich,
    "rk4": lambda: rich("RK4"),
    "implicit": lambda: rich("implicit", motor=ACTIVATION),
    "implicitfast": lambda: rich("implicitfast", motor=ACTIVATION),
    "activation": lambda: rich(motor=ACTIVATION, sensor=FORCE_SENSORS),
    "activation_rk4": lambda: rich("RK4", motor=ACTIVATION.replace("filterexact", "filter")),
    "elliptic": lambda: rich(option='cone="elliptic" impratio="5"'),
    "fluid": lambda: rich(option='density="500" viscosity=".5" wind="1 0 0"'),
    "no_gravity": lambda: rich(flag='gravity="disable"'),
    "energy": lambda: rich(flag='energy="enable" fwdinv="enable"'),
    "fixed_tendon": lambda: rich(tendon=FIXED, motor='<motor tendon="t" ctrlrange="-1 1"/>'),
    "spatial_tendon": lambda: rich(tendon=SPATIAL, motor='<motor tendon="s" ctrlrange="-1 1"/>'),
    "spatial_tendon_rk4": lambda: rich("RK4", tendon=SPATIAL),
    "force_sensors": lambda: rich(sensor=FORCE_SENSORS),
    "force_sensors_rk4": lambda: rich("RK4", sensor=FORCE_SENSORS),
    "no_sensors": lambda: rich(sensor=FORCE_SENSORS, flag='sensor="disable"'),
    "sensors": lambda: sensors(*(kind for kind in SENSORS if kind not in NOT_ON_MJX)),
    "subtree_sensors": lambda: rich(sensor=SUBTREE_SENSORS),
    "subtree_sensors_rk4": lambda: rich("RK4", sensor=SUBTREE_SENSORS),
}


class Case(NamedTuple):
    """A state, a control, and MuJoCo's arrays at both moments."""

    state: PhysicsState
    ctrl: np.ndarray
    reset: dict[str, np.ndarray]
    step: dict[str, np.ndarray]


def array_names(model: mujoco.MjModel) -> list[str]:
    """All arrays of `mjData`, the contacts, and the time."""
    data = mujoco.MjData(model)
    arrays = (name for name in dir(data) if isinstance(getattr(data, name), np.ndarray))
    return [*arrays, "contact", "time"]


def reference_cases(model: mujoco.MjModel, num_cases: int = 6, every: int = 12) -> list[Case]:
    """Cases of one trajectory under random controls, with float32 states. As in Gymnasium, one `MjData` lives on."""
    rng, data, fresh = np.random.default_rng(0), mujoco.MjData(model), mujoco.MjData(model)
    names = array_names(model)
    data.qpos[:] = model.qpos0 + 0.02 * rng.normal(size=model.nq)
    data.qvel[:] = 0.5 * rng.normal(size=model.nv)
    cases = []
    for i in range(num_cases * every):
        act = np.float32(data.act) if model.na else None
        state = PhysicsState(np.float32(data.qpos), np.float32(data.qvel), np.float32(data.qacc_warmstart), act)
        ctrl = np.float32(rng.uniform(-1, 1, model.nu))
        mujoco.mj_resetData(model, fresh)
        _set(fresh, state)
        mujoco.mj_forward(model, fresh)
        _set(data, state)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=NUM_SUBSTEPS)
        mujoco.mj_rnePostConstraint(model, data)
        if i % every == every - 1:
            cases.append(Case(state, ctrl, *({name: _copy(one, name) for name in names} for one in (fresh, data))))
    return cases


def _set(data: mujoco.MjData, state: PhysicsState) -> None:
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:], act = state[:4]
    if act is not None:
        data.act[:] = act


def _copy(data: mujoco.MjData, name: str) -> Any:
    value = getattr(data, name)
    return np.array(value, np.float64) if isinstance(value, np.ndarray) else value


def accepted(model: mujoco.MjModel, engine: str, names: list[str]) -> Iterator[str]:
    """The arrays that an engine does not refuse, each tried by itself."""
    for name in names:
        try:
            refuse_derived(model, engine, (name,))
        except UserError as error:
            if "\n" in str(error) or f"'{name}'" not in str(error):
                raise ValueError(f"not one line that names the array: {error}") from error
            continue
        yield name


def errors(model: mujoco.MjModel, engine: str, names: tuple[str, ...], cases: list[Case]) -> dict[str, list[float]]:
    """Largest errors by name at both moments, relative to the array's largest value, or absolute if that is zero."""
    made = make_engine(engine, model, NUM_SUBSTEPS, names)
    state = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(case.state for case in cases))
    ctrl = jnp.asarray(np.stack([case.ctrl for case in cases]))
    found = (jax.jit(jax.vmap(made.forward))(state), jax.jit(jax.vmap(made.step))(state, ctrl)[1])
    return {
        name: [
            _error(np.stack([getattr(case, moment)[name] for case in cases]), np.asarray(at_moment[name]))
            for moment, at_moment in zip(MOMENTS, found, strict=True)
        ]
        for name in names
    }


def _error(expected: np.ndarray, found: np.ndarray) -> float:
    assert found.dtype == np.float32 and found.shape == expected.shape
    scale = np.abs(expected).max(initial=0.0)
    return float(np.abs(found - expected).max(initial=0.0) / (scale or 1.0))


def sweep(model: mujoco.MjModel, engine: str, is_alone: bool) -> dict[str, list[float]]:
    """Errors of all arrays that an engine does not refuse. `LATE_ARRAYS` are compiled alone, and all if asked to."""
    names = list(accepted(model, engine, array_names(model)))
    alone = names if is_alone else [name for name in names if name in LATE_ARRAYS]
    groups = [*((name,) for name in alone), tuple(name for name in names if name not in alone)]
    cases, found = reference_cases(model), {}
    for group in filter(None, groups):
        found |= errors(model, engine, group, cases)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=ENGINES)
    parser.add_argument("--models", nargs="+", choices=list(MODELS), default=list(MODELS))
    parser.add_argument("--alone", action="store_true", help="compile each array alone")
    arguments = parser.parse_args()
    prepare_jax()
    worst: dict[tuple[str, str], list[float]] = {}
    refused: dict[tuple[str, str], list[str]] = {}
    for name in arguments.models:
        model = MODELS[name]()
        for engine in arguments.engines:
            try:
                found = sweep(model, engine, arguments.alone)
            except UserError as error:
                print(f"{name} on {engine}: {error}", flush=True)
                continue
            for array in array_names(model):
                if array not in found:
                    refused.setdefault((array, engine), []).append(name)
                    continue
                old = worst.get((array, engine), [0.0, 0.0])
                worst[array, engine] = [max(pair) for pair in zip(old, found[array], strict=True)]
                if max(found[array]) > TOLERANCE[engine]:
                    print(f"{name}: {array} on {engine}: {found[array]}", flush=True)
            print(f"{name} on {engine}: {len(found)} arrays compared", flush=True)
    _print_table(array_names(model), arguments, worst, refused)
    return int(any(max(found) > TOLERANCE[engine] for (_, engine), found in worst.items()))


def _print_table(names: list[str], arguments: argparse.Namespace, worst: dict, refused: dict) -> None:
    print("", "array".ljust(20) + "".join(f"{f'{e} {m}':>14}" for e in arguments.engines for m in MOMENTS), sep="\n")
    for name in names:
        cells = []
        for engine in arguments.engines:
            for error in worst.get((name, engine), [None, None]):
                equal = "equal" if error is not None and error <= TOLERANCE[engine] else f"{error:.1e}" if error else ""
                some = "*" if equal and (name, engine) in refused else ""
                cells.append(f"{equal + some or 'refused':>14}")
        print(name.ljust(20) + "".join(cells))
    print("\n* refused for some models:")
    for (name, engine), of in refused.items():
        if (name, engine) in worst:
            print(f"{name} on {engine}: {', '.join(of)}")


if __name__ == "__main__":
    sys.exit(main())
