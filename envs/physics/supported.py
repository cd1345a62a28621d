"""Elements that an engine does not simulate. A model with one is refused before compilation, by the element's name.

MuJoCo's complete state is `mjSTATE_INTEGRATION`. `PhysicsState` carries position, velocity, the solver's initial guess
and activations. Mocap bodies and equality flags never change during an episode, so they need not be carried. The rest
is refused on every engine. MJX silently ignores further features; those are refused on its engines.
"""

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Shaped

from mjx_walk.envs.physics.elements import (
    constraint_settings,
    contact_friction,
    moving_bodies,
    names_of_pair,
    pairs_that_move,
)
from mjx_walk.envs.physics.feature_table import EVERY_ENGINE, FeatureTable, Mask, any_of, name_of
from mjx_walk.envs.physics.jax_features import JAX_FEATURES
from mjx_walk.utils.errors import UserError, first_line

__all__ = ["FEATURES", "refuse_unsupported", "unsupported_by_mjx"]

FEATURES = FeatureTable()
"""Features that no engine simulates, or not both MJX engines. Those of `jax` alone are in `JAX_FEATURES`."""

_MJX = ("warp", "jax")
_Flag = mujoco.mjtDisableBit
_Integrator = mujoco.mjtIntegrator
_INTEGRATORS = (
    *(_Integrator.mjINT_EULER, _Integrator.mjINT_RK4, _Integrator.mjINT_IMPLICITFAST, _Integrator.mjINT_IMPLICIT),
)
_LEAST_PYRAMIDAL_FRICTION = 0.05
"""With it, velocities after a step differ from C's by at most 1.1e-3, relative to one plus their change."""


def refuse_unsupported(model: mujoco.MjModel, engine: str) -> None:
    """Check that an engine simulates everything that a model has.

    Args:
        model: the MuJoCo model.
        engine: name of the engine.

    Raises:
        UserError: it does not; the message names the first element.
    """
    for feature in (*FEATURES, *JAX_FEATURES):
        if engine not in feature.engines:
            continue
        for user in feature.users(model):
            others = [name for name in reversed(EVERY_ENGINE) if name not in feature.engines]
            also = f", or use physics={others[0]}" if others else ""
            raise UserError(f"physics={engine} does not simulate {feature.what} ({user}); {feature.advice}{also}")


def unsupported_by_mjx(engine: str, error: Exception) -> UserError:
    """The error to raise where MJX refuses a model.

    Args:
        engine: name of the engine.
        error: MJX's own error.
    """
    reason = first_line(error)
    return UserError(f"physics={engine}: MJX does not support this model: {reason}; use physics=c")


@FEATURES.entry(
    EVERY_ENGINE, None, "this integrator", "set integrator to Euler, RK4, implicitfast or implicit in <option>"
)
def _other_integrators(model: mujoco.MjModel) -> Iterator[str]:
    yield from _integrator_if(model, model.opt.integrator not in _INTEGRATORS)


@FEATURES.entry(_MJX, None, "this integrator", "set integrator to implicitfast, Euler or RK4 in <option>")
def _fully_implicit(model: mujoco.MjModel) -> Iterator[str]:
    yield from _integrator_if(model, model.opt.integrator == _Integrator.mjINT_IMPLICIT)


def _integrator_if(model: mujoco.MjModel, is_refused: bool) -> Iterator[str]:
    if is_refused:
        name = _Integrator(model.opt.integrator).name.removeprefix("mjINT_").lower()
        yield f'integrator="{name}"'


@FEATURES.entry(EVERY_ENGINE, "actuator", "user dynamics of an activation", "use another dyntype")
def _user_dynamics(model: mujoco.MjModel) -> Mask:
    """Motors whose activation a callback changes."""
    return model.actuator_dyntype == mujoco.mjtDyn.mjDYN_USER


@FEATURES.entry(_MJX, "actuator", "PID controllers", "use <position>")
def _pid_motors(model: mujoco.MjModel) -> Mask:
    is_pid = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_PID
    return is_pid | (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_PID)


@FEATURES.entry(
    ("warp",), "actuator", "filterexact and inductance with RK4", 'set integrator="implicitfast", or dyntype="filter"'
)
def _exact_filters_with_rk4(model: mujoco.MjModel) -> Mask:
    """Motors whose activation Warp advances by another formula than MuJoCo in the stages of RK4."""
    is_exact = np.isin(model.actuator_dyntype, (mujoco.mjtDyn.mjDYN_FILTEREXACT, mujoco.mjtDyn.mjDYN_DCMOTOR))
    return is_exact & (model.actuator_actadr >= 0) & (model.opt.integrator == _Integrator.mjINT_RK4)


@FEATURES.entry(
    ("warp",), None, "implicitfast with this flag", 'remove the flag, or set integrator="Euler" in <option>'
)
def _implicit_without_damper_or_actuation(model: mujoco.MjModel) -> Iterator[str]:
    """Flags with which Warp leaves out the derivatives of servos as well as of dampers."""
    if model.opt.integrator == _Integrator.mjINT_IMPLICITFAST:
        for flag, name in ((_Flag.mjDSBL_DAMPER, "damper"), (_Flag.mjDSBL_ACTUATION, "actuation")):
            if model.opt.disableflags & flag:
                yield f'<flag {name}="disable"/>'


@FEATURES.entry(EVERY_ENGINE, "actuator", "actuators with a delay", "remove nsample and delay")
def _delayed_actuators(model: mujoco.MjModel) -> Mask:
    return any_of(model.actuator_history)


@FEATURES.entry(EVERY_ENGINE, "sensor", "sensors with a history", "remove nsample, delay and interval")
def _sensors_with_history(model: mujoco.MjModel) -> Mask:
    return any_of(model.sensor_history)


@FEATURES.entry(EVERY_ENGINE, None, "plugins", "remove <extension> and the elements that use it")
def _plugins(model: mujoco.MjModel) -> list[str]:
    return [f"plugin instance {i}" for i in range(model.nplugin)]


@FEATURES.entry(EVERY_ENGINE, None, "sleeping bodies", "remove the flag")
def _sleeping_bodies(model: mujoco.MjModel) -> list[str]:
    is_enabled = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
    return ['<flag sleep="enable"/>'] if is_enabled else []


@FEATURES.entry(_MJX, "actuator", "disabled actuator groups", "remove actuatorgroupdisable, or the motor")
def _disabled_motors(model: mujoco.MjModel) -> Mask:
    """Motors of a group that `actuatorgroupdisable` names. Groups outside 0 to 30 cannot be disabled."""
    group = model.actuator_group
    return (group >= 0) & (group <= 30) & (model.opt.disableactuator >> np.clip(group, 0, 30) & 1).astype(bool)


@FEATURES.entry(_MJX, "actuator", "actuator armature", "set armature on the joint")
def _motors_with_armature(model: mujoco.MjModel) -> Mask:
    return any_of(model.actuator_armature)


@FEATURES.entry(_MJX, "eq", "connect and weld constraints as MuJoCo does", "remove the constraint")
def _moving_equalities(model: mujoco.MjModel) -> Mask:
    """Active equalities whose Jacobian changes with the position. MuJoCo adds a term for that change, MJX does not."""
    is_off = model.opt.disableflags & (_Flag.mjDSBL_EQUALITY | _Flag.mjDSBL_CONSTRAINT)
    is_moving = np.isin(model.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))
    return is_moving & model.eq_active0.astype(bool) & (not is_off)


@FEATURES.entry(_MJX, "joint", "both limits of a joint at the same time", "set a margin below half the range")
def _overlapping_joint_limits(model: mujoco.MjModel) -> Mask:
    """Joints whose upper and lower limit can act at the same time. MJX has one row for both, MuJoCo has two."""
    is_scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    return is_scalar & _overlap(model, model.jnt_limited, model.jnt_range, model.jnt_margin)


@FEATURES.entry(_MJX, "tendon", "both limits of a tendon at the same time", "set a margin below half the range")
def _overlapping_tendon_limits(model: mujoco.MjModel) -> Mask:
    return _overlap(model, model.tendon_limited, model.tendon_range, model.tendon_margin)


def _overlap(model: mujoco.MjModel, limited: Mask, limits: Shaped[np.ndarray, "n 2"], margin: Mask) -> Mask:
    """Whether both limits can act at the same time."""
    is_on = not model.opt.disableflags & (_Flag.mjDSBL_LIMIT | _Flag.mjDSBL_CONSTRAINT)
    return (limited != 0) & (limits[:, 1] - limits[:, 0] < 2 * margin) & is_on


@FEATURES.entry(
    _MJX,
    "body",
    "contacts of a body whose joints only turn it about its center of mass",
    "move the body's joint or mass by a fifth of its size",
)
def _balanced_bodies(model: mujoco.MjModel) -> Mask:
    """Moving bodies with contacts whose centre of mass no joint moves. MJX's solver divides by their inertia, zero."""
    collides = np.zeros(model.nbody, bool)
    collides[model.geom_bodyid[pairs_that_move(model)[0]]] = True
    return moving_bodies(model) & collides & (model.body_invweight0[:, 0] < mujoco.mjMINVAL)


@FEATURES.entry(
    _MJX,
    None,
    f"pyramidal contacts with a friction below {_LEAST_PYRAMIDAL_FRICTION}",
    'set cone="elliptic" in <option>, or condim="1" for contacts without friction',
)
def _slippery_contacts(model: mujoco.MjModel) -> Iterator[str]:
    """Pairs of geoms whose pyramidal contacts have little friction.

    A pyramidal contact divides by the square of its friction, and MJX computes in float32.
    """
    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return
    geoms, pairs = pairs_that_move(model)
    condim, friction = contact_friction(model, geoms, pairs)
    for both in geoms[(condim > 1) & (friction < _LEAST_PYRAMIDAL_FRICTION)]:
        yield names_of_pair(model, both)


@FEATURES.entry(_MJX, None, "the noslip solver as MuJoCo does", "set noslip_iterations to 0 in <option>")
def _noslip_solver(model: mujoco.MjModel) -> list[str]:
    """The noslip solver. Warp's result depends on the order of the contacts, which is arbitrary on a GPU."""
    return ["noslip_iterations"] if model.opt.noslip_iterations > 0 else []


@FEATURES.entry(
    _MJX,
    "tendon",
    "a tendon with limits, friction or an equality that no joint moves in the model's own pose",
    "remove them",
)
def _unmoved_tendons(model: mujoco.MjModel) -> Mask:
    """Constrained tendons without inertia in the model's own pose. MJX's solver divides by it."""
    is_constrained = (model.tendon_limited != 0) | (model.tendon_frictionloss > 0)
    is_tendon = model.eq_type == mujoco.mjtEq.mjEQ_TENDON
    for tied in (model.eq_obj1id[is_tendon], model.eq_obj2id[is_tendon]):
        is_constrained[tied[tied >= 0]] = True
    return is_constrained & (model.tendon_invweight0 < mujoco.mjMINVAL)


@FEATURES.entry(
    _MJX,
    None,
    "a solref of one positive number, for which MuJoCo takes its default",
    "make both numbers positive or both negative",
)
def _mixed_solrefs(model: mujoco.MjModel) -> Iterator[str]:
    """Elements with a `solref` of one positive number. MuJoCo puts its default there, MJX takes the numbers."""
    for kind, index, solref, _ in constraint_settings(model):
        if (solref[0] > 0) != (solref[1] > 0):
            yield name_of(model, kind, index)


@FEATURES.entry(_MJX, "actuator", "user gains and biases", "use another gaintype or biastype")
def _user_motors(model: mujoco.MjModel) -> Mask:
    """Motors whose force a callback gives. Without one, MuJoCo has a gain of one, MJX of zero."""
    is_gain = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_USER
    return is_gain | (model.actuator_biastype == mujoco.mjtBias.mjBIAS_USER)


@FEATURES.entry(_MJX, "joint", "negative damping and friction", "set damping and frictionloss to zero or more")
def _negative_joints(model: mujoco.MjModel) -> Mask:
    """Joints with negative damping or friction, which MuJoCo accepts."""
    is_negative = np.zeros(model.njnt, bool)
    is_negative[model.dof_jntid[(model.dof_damping < 0) | (model.dof_frictionloss < 0)]] = True
    return is_negative


@FEATURES.entry(_MJX, "tendon", "negative damping and friction", "set damping and frictionloss to zero or more")
def _negative_tendons(model: mujoco.MjModel) -> Mask:
    return (model.tendon_damping < 0) | (model.tendon_frictionloss < 0)


@FEATURES.entry(
    ("warp",),
    "actuator",
    "limits of single motors on a tendon that limits their sum",
    "remove forcerange from the motors, or actuatorfrcrange from the tendon",
)
def _motors_limited_twice(model: mujoco.MjModel) -> Mask:
    """Motors with a limit on their own force, of several on a tendon that limits their sum."""
    on_tendon = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    tendon = np.where(on_tendon, model.actuator_trnid[:, 0], 0)
    num_motors = np.bincount(tendon[on_tendon], minlength=max(model.ntendon, 1))
    is_limited = model.tendon_actfrclimited.astype(bool) if model.ntendon else np.zeros(1, bool)
    return on_tendon & model.actuator_forcelimited.astype(bool) & is_limited[tendon] & (num_motors[tendon] > 1)


@FEATURES.entry(("warp",), "pair", "two contact pairs of the same geoms", "remove one of them")
def _repeated_pairs(model: mujoco.MjModel) -> Mask:
    """Pairs whose geoms an earlier one has. MuJoCo makes the contacts of both."""
    geoms = np.sort(np.stack([model.pair_geom1, model.pair_geom2]), axis=0)
    is_repeated = np.ones(model.npair, bool)
    is_repeated[np.unique(geoms, axis=1, return_index=True)[1]] = False
    return is_repeated
