"""What an engine does not simulate. A model that has it is refused before compilation; the error names the element.

MuJoCo's complete state is `mjSTATE_INTEGRATION`. `PhysicsState` carries position, velocity and the solver's initial
guess. Mocap bodies and equality flags never change during an episode, so they need not be carried. The rest is refused
on every engine. MJX silently ignores further features; those are refused on its engines.
"""

import logging
from collections.abc import Callable, Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Shaped

from mjx_walk.utils.errors import UserError, first_line

__all__ = ["refuse_unsupported", "unsupported_by_mjx", "warn_of_approximations"]

_LOGGER = logging.getLogger(__name__)

_EVERY = ("warp", "jax", "c")
_MJX = ("warp", "jax")


class _Feature(NamedTuple):
    """A feature of a model that some engines do not simulate."""

    engines: tuple[str, ...]
    """The engines that do not simulate it."""
    users: Callable[[mujoco.MjModel], Iterator[str]]
    """The elements of a model that use it, as `kind 'name'`."""
    what: str
    """The feature, as the subject of a sentence."""
    advice: str
    """What to change in the model."""


def refuse_unsupported(model: mujoco.MjModel, engine: str) -> None:
    """Check that an engine simulates everything that a model has.

    Args:
        model: the MuJoCo model.
        engine: name of the engine.

    Raises:
        UserError: it does not; the message names the first element.
    """
    for feature in _FEATURES:
        if engine not in feature.engines:
            continue
        for user in feature.users(model):
            others = [name for name in reversed(_EVERY) if name not in feature.engines]
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


def _named(
    kind: str, is_user: Callable[[mujoco.MjModel], Shaped[np.ndarray, " n"]]
) -> Callable[[mujoco.MjModel], Iterator[str]]:
    """The elements of one kind for which a condition on the model's arrays holds."""

    def users(model: mujoco.MjModel) -> Iterator[str]:
        for i in np.flatnonzero(is_user(model)):
            name = getattr(model, kind)(int(i)).name
            yield f"{_SPOKEN.get(kind, kind)} '{name}'" if name else f"{_SPOKEN.get(kind, kind)} {i}"

    return users


def _option(
    text: str, is_used: Callable[[mujoco.MjOption], bool | int | float]
) -> Callable[[mujoco.MjModel], Iterator[str]]:
    """The `<option>` for which a condition holds."""

    def users(model: mujoco.MjModel) -> Iterator[str]:
        if is_used(model.opt):
            yield text

    return users


def _any(*arrays: Shaped[np.ndarray, "n ..."]) -> Shaped[np.ndarray, " n"]:
    """For each element, whether any value of any array is not zero."""
    return np.array([any(np.any(row) for row in rows) for rows in zip(*arrays, strict=True)], bool)


def _plugins(model: mujoco.MjModel) -> Iterator[str]:
    for i in range(model.nplugin):
        yield f"plugin instance {i}"


def _disabled_motors(model: mujoco.MjModel) -> Shaped[np.ndarray, " motors"]:
    """Motors of a group that `actuatorgroupdisable` names. Groups outside 0 to 30 cannot be disabled."""
    group = model.actuator_group
    return (group >= 0) & (group <= 30) & (model.opt.disableactuator >> np.clip(group, 0, 30) & 1).astype(bool)


def _polynomial_joints(model: mujoco.MjModel) -> Shaped[np.ndarray, " joints"]:
    """Joints whose stiffness or damping has terms of higher order."""
    damping = _any(model.dof_dampingpoly)[model.jnt_dofadr] if model.njnt else np.zeros(0, bool)
    return _any(model.jnt_stiffnesspoly) | damping


def _fluid_geoms(model: mujoco.MjModel) -> Shaped[np.ndarray, " geoms"]:
    """Geoms with fluid forces of their own, in a medium."""
    has_medium = model.opt.density > 0 or model.opt.viscosity > 0
    return (model.geom_fluid[:, 0] > 0) & has_medium


def _moving_equalities(model: mujoco.MjModel) -> Shaped[np.ndarray, " equalities"]:
    """Active equalities whose Jacobian changes with the position. MuJoCo adds a term for that change, MJX does not."""
    is_off = model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    is_moving = np.isin(model.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))
    return is_moving & model.eq_active0.astype(bool) & (not is_off)


_SPOKEN = {"actuator": "motor", "eq": "equality constraint"}

_FEATURES = (
    _Feature(
        _EVERY,
        _named("actuator", lambda m: m.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE),
        "actuators with an activation state",
        'set dyntype="none", or use <motor>, <position> or <velocity> without a time constant',
    ),
    _Feature(
        _EVERY,
        _named("actuator", lambda m: _any(m.actuator_history)),
        "actuators with a delay",
        "remove nsample and delay",
    ),
    _Feature(
        _EVERY,
        _named("sensor", lambda m: _any(m.sensor_history)),
        "sensors with a history",
        "remove nsample, delay and interval",
    ),
    _Feature(_EVERY, _plugins, "plugins", "remove <extension> and the elements that use it"),
    _Feature(
        _EVERY,
        _option('<flag sleep="enable"/>', lambda o: o.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP),
        "sleeping bodies",
        "remove the flag",
    ),
    _Feature(
        _MJX,
        _named("actuator", _disabled_motors),
        "disabled actuator groups",
        "remove actuatorgroupdisable, or the motor",
    ),
    _Feature(
        _MJX,
        _named("actuator", lambda m: _any(m.actuator_armature)),
        "actuator armature",
        "set armature on the joint",
    ),
    _Feature(
        _MJX,
        _named("eq", _moving_equalities),
        "connect and weld constraints as MuJoCo does",
        "remove the constraint",
    ),
    _Feature(
        ("jax",),
        _named("actuator", lambda m: _any(m.actuator_damping, m.actuator_dampingpoly)),
        "actuator damping",
        "set damping on the joint",
    ),
    _Feature(
        ("jax",),
        _named("joint", _polynomial_joints),
        "polynomial stiffness and damping",
        "give the joint one stiffness and one damping",
    ),
    _Feature(
        ("jax",),
        _named("tendon", lambda m: _any(m.tendon_stiffnesspoly, m.tendon_dampingpoly)),
        "polynomial stiffness and damping",
        "give the tendon one stiffness and one damping",
    ),
    _Feature(
        ("jax",),
        _named("geom", lambda m: _any(m.geom_adhesion)),
        "adhesion",
        "remove adhesion",
    ),
    _Feature(
        ("jax",),
        _named("geom", lambda m: _any(m.geom_surfacevel)),
        "moving surfaces",
        "remove surfacevel",
    ),
    _Feature(
        ("jax",),
        _named("geom", _fluid_geoms),
        "the fluid forces of individual geoms",
        "remove fluidshape and fluidcoef",
    ),
    _Feature(
        ("jax",),
        _option("noslip_iterations", lambda o: o.noslip_iterations > 0),
        "the noslip solver",
        "set noslip_iterations to 0 in <option>",
    ),
)

_Geom = mujoco.mjtGeom
_AS_IN_MUJOCO = {
    *((_Geom.mjGEOM_PLANE, other) for other in (_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_CAPSULE)),
    *((_Geom.mjGEOM_PLANE, other) for other in (_Geom.mjGEOM_ELLIPSOID, _Geom.mjGEOM_CYLINDER)),
    *((_Geom.mjGEOM_SPHERE, other) for other in (_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_BOX)),
    (_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_CAPSULE),
}
"""Pairs of geoms whose contacts the `jax` engine finds as MuJoCo does. For others it finds other points."""


def warn_of_approximations(model: mujoco.MjModel, engine: str, enough_iterations: int) -> None:
    """Log a warning for what an MJX engine simulates, but otherwise than MuJoCo's C library.

    Args:
        model: the model as loaded.
        engine: `warp` or `jax`.
        enough_iterations: iterations of the constraint solver that suffice to converge.
    """
    fewest = min(model.opt.iterations, model.opt.ls_iterations)
    if fewest < enough_iterations:
        _LOGGER.warning(
            "the model stops the constraint solver after %d iterations; physics=%s lets it converge, unlike physics=c",
            fewest,
            engine,
        )
    if engine != "jax":
        return
    from mujoco.mjx._src import collision_driver

    for first, second, _ in collision_driver.geom_pairs(model):
        kinds = tuple(_Geom(model.geom_type[geom]) for geom in (first, second))
        if kinds not in _AS_IN_MUJOCO:
            names = [kind.name.removeprefix("mjGEOM_").lower() for kind in kinds]
            _LOGGER.warning(
                "physics=jax finds other contact points than MuJoCo between %s and %s; physics=warp or c is closer",
                *(
                    f"{kind} '{model.geom(int(geom)).name or geom}'"
                    for kind, geom in zip(names, (first, second), strict=True)
                ),
            )
            return
