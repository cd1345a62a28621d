"""Changes of a MuJoCo model by factors, in place."""

import mujoco
import numpy as np
from jaxtyping import Float

__all__ = ["first_moving_body", "scale_damping", "scale_friction", "scale_mass", "scale_strength"]

Factors = float | Float[np.ndarray, " n"]

_MUSCLE = {"gainprm": mujoco.mjtGain.mjGAIN_MUSCLE, "biasprm": mujoco.mjtBias.mjBIAS_MUSCLE}
_MUSCLE_FORCES = slice(2, 4)
"""Columns of a muscle's parameters: its peak force, and the scale of the force that follows if that is negative."""
_FORCES = slice(0, 3)
"""Columns of an affine gain or bias: constant, length and velocity."""


def scale_friction(model: mujoco.MjModel, factor: float) -> None:
    """Scale the sliding friction of every geom and of every explicit pair."""
    model.geom_friction[:, 0] *= factor
    model.pair_friction[:, :2] *= factor  # a pair has two sliding directions


def scale_mass(model: mujoco.MjModel, factors: Factors) -> None:
    """Scale the masses and inertias of all bodies. `mj_setConst` must follow.

    Args:
        model: the model.
        factors: one, or `[nbody]`.
    """
    model.body_mass[:] *= factors
    model.body_inertia[:] *= np.reshape(factors, (-1, 1))


def scale_damping(model: mujoco.MjModel, factors: Factors) -> None:
    """Scale the damping of all joints.

    Args:
        model: the model.
        factors: one, or `[njnt]`.
    """
    model.dof_damping[:] *= np.broadcast_to(factors, model.njnt)[model.dof_jntid]


def scale_strength(model: mujoco.MjModel, factors: Factors) -> None:
    """Scale the forces of all motors, at every length and velocity, and their force limits.

    The feedback of a servo is scaled with its gain, so that it keeps its targets.

    Args:
        model: the model.
        factors: one, or one for each motor.
    """
    factors = np.broadcast_to(factors, len(model.actuator_gainprm))[:, None]
    for name, muscle in _MUSCLE.items():
        is_muscle = getattr(model, f"actuator_{name[:4]}type") == muscle
        parameters = getattr(model, f"actuator_{name}")
        parameters[~is_muscle, _FORCES] *= factors[~is_muscle]
        parameters[is_muscle, _MUSCLE_FORCES] *= factors[is_muscle]
    model.actuator_forcerange[:] *= factors


def first_moving_body(model: mujoco.MjModel) -> int:
    """Index of the first body with a joint: a robot's torso, or the base of an arm."""
    return int(np.flatnonzero(model.body_dofnum)[0])
