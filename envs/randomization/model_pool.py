"""A pool of changed models, from which episodes draw."""

import copy
import logging

import mujoco
import numpy as np

from mjx_walk.envs.randomization.edits import (
    first_moving_body,
    scale_damping,
    scale_friction,
    scale_mass,
    scale_strength,
)
from mjx_walk.envs.randomization.options import Randomization

__all__ = ["ModelPool", "change_model", "changed_models"]

_LOGGER = logging.getLogger(__name__)

ModelPool = dict[str, np.ndarray]
"""Values of `MjModel` by name, `[num_models, …]` each: all that differ from the original in any of the models."""

_NUM_PROBES = 16
"""Models that are compared with the original in all values. A value that depends on a draw differs in the first."""


def change_model(model: mujoco.MjModel, options: Randomization, random: np.random.Generator) -> None:
    """Change a model by one draw, and recompute what MuJoCo derives from masses (`mj_setConst`).

    Args:
        model: the model, which is changed.
        options: the ranges.
        random: generator of the draws.
    """
    scale_friction(model, random.uniform(*options.friction))
    scale_mass(model, random.uniform(*options.mass, model.nbody))
    shift = random.uniform(-options.center_of_mass, options.center_of_mass, 3)
    model.body_ipos[first_moving_body(model)] += shift
    scale_strength(model, random.uniform(*options.torque, len(model.actuator_gainprm)))
    scale_damping(model, random.uniform(*options.damping, model.njnt))
    mujoco.mj_setConst(model, mujoco.MjData(model))


def changed_models(model: mujoco.MjModel, options: Randomization) -> ModelPool:
    """Draw the models of a pool. Model i is the same for the same ranges, whatever the number of models.

    Args:
        model: the original, which is not changed.
        options: the ranges and the number of models.
    """
    changed = copy.copy(model)
    original = _values(model)
    names: set[str] = set()
    for index in range(min(_NUM_PROBES, options.num_models)):
        _set_values(changed, original)
        change_model(changed, options, np.random.default_rng(index))
        names |= {name for name, value in _values(changed).items() if not np.array_equal(value, original[name])}
    pool: dict[str, list[np.ndarray]] = {name: [] for name in sorted(names)}
    for index in range(options.num_models):
        _set_values(changed, {name: original[name] for name in pool})
        change_model(changed, options, np.random.default_rng(index))
        for name, values in pool.items():
            values.append(getattr(changed, name).copy())
    _LOGGER.info("Drew %d models with changed physics", options.num_models)
    return {name: np.stack(values) for name, values in pool.items()}


def _values(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Copies of the arrays of a model, without those of meshes, height fields and textures, which do not change."""
    names = (name for name in dir(model) if not name.startswith(("_", "mesh_", "hfield_", "tex_", "skin_", "flex_")))
    arrays = {name: getattr(model, name) for name in names}
    return {name: value.copy() for name, value in arrays.items() if isinstance(value, np.ndarray) and value.size}


def _set_values(model: mujoco.MjModel, values: dict[str, np.ndarray]) -> None:
    for name, value in values.items():
        getattr(model, name)[:] = value
