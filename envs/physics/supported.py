"""Elements that an engine does not simulate. A model with one is refused before compilation, by the element's name.

MuJoCo's complete state is `mjSTATE_INTEGRATION`. `PhysicsState` carries position, velocity and the solver's initial
guess. Mocap bodies and equality flags never change during an episode, so they need not be carried. The rest is refused
on every engine. MJX silently ignores further features; those are refused on its engines.
"""

from typing import NamedTuple

import mujoco

from mjx_walk.envs.physics import constraint_settings, elements
from mjx_walk.utils.errors import UserError, first_line

__all__ = ["refuse_unsupported", "unsupported_by_mjx"]

_EVERY = ("warp", "jax", "c")
_MJX = ("warp", "jax")


class _Feature(NamedTuple):
    """A feature of a model that some engines do not simulate."""

    engines: tuple[str, ...]
    """The engines that do not simulate it."""
    users: elements.Users
    """The elements of a model that use it."""
    what: str
    """The feature, as the subject of a sentence."""
    advice: str
    """Change of the model that makes it acceptable."""


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


_FEATURES = (
    _Feature(
        _EVERY,
        elements.named("actuator", lambda m: m.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE),
        "actuators with an activation state",
        'set dyntype="none", or use <motor>, <position> or <velocity> without a time constant',
    ),
    _Feature(
        _EVERY,
        elements.named("actuator", lambda m: elements.any_of(m.actuator_history)),
        "actuators with a delay",
        "remove nsample and delay",
    ),
    _Feature(
        _EVERY,
        elements.named("sensor", lambda m: elements.any_of(m.sensor_history)),
        "sensors with a history",
        "remove nsample, delay and interval",
    ),
    _Feature(_EVERY, elements.plugins, "plugins", "remove <extension> and the elements that use it"),
    _Feature(
        _EVERY,
        elements.option('<flag sleep="enable"/>', lambda o: o.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP),
        "sleeping bodies",
        "remove the flag",
    ),
    _Feature(
        _MJX,
        elements.named("actuator", elements.disabled_motors),
        "disabled actuator groups",
        "remove actuatorgroupdisable, or the motor",
    ),
    _Feature(
        _MJX,
        elements.named("actuator", lambda m: elements.any_of(m.actuator_armature)),
        "actuator armature",
        "set armature on the joint",
    ),
    _Feature(
        _MJX,
        elements.named("eq", elements.moving_equalities),
        "connect and weld constraints as MuJoCo does",
        "remove the constraint",
    ),
    _Feature(
        _MJX,
        elements.named("joint", elements.overlapping_joint_limits),
        "both limits of a joint at the same time",
        "set a margin below half the range",
    ),
    _Feature(
        _MJX,
        elements.named("tendon", elements.overlapping_tendon_limits),
        "both limits of a tendon at the same time",
        "set a margin below half the range",
    ),
    _Feature(
        _MJX,
        elements.named("body", elements.balanced_bodies),
        "contacts of a body whose joints only turn it about its center of mass",
        "move the body's joint or mass by a fifth of its size",
    ),
    _Feature(
        _MJX,
        elements.slippery_contacts,
        f"pyramidal contacts with a friction below {elements.LEAST_PYRAMIDAL_FRICTION}",
        'set cone="elliptic" in <option>, or condim="1" for contacts without friction',
    ),
    _Feature(
        _MJX,  # Warp's result depends on the order of the contacts, which is arbitrary on a GPU
        elements.option("noslip_iterations", lambda o: o.noslip_iterations > 0),
        "the noslip solver as MuJoCo does",
        "set noslip_iterations to 0 in <option>",
    ),
    _Feature(
        _MJX,
        elements.named("tendon", elements.unmoved_tendons),
        "a tendon with limits, friction or an equality that no joint moves in the model's own pose",
        "remove them",
    ),
    _Feature(
        _MJX,
        constraint_settings.mixed_solrefs,
        "a solref of one positive number, for which MuJoCo takes its default",
        "make both numbers positive or both negative",
    ),
    _Feature(
        _MJX,
        elements.named("actuator", elements.user_motors),
        "user gains and biases",
        "use another gaintype or biastype",
    ),
    _Feature(
        _MJX,
        elements.named("joint", elements.negative_joints),
        "negative damping and friction",
        "set damping and frictionloss to zero or more",
    ),
    _Feature(
        _MJX,
        elements.named("tendon", elements.negative_tendons),
        "negative damping and friction",
        "set damping and frictionloss to zero or more",
    ),
    _Feature(
        ("warp",),
        elements.named("actuator", elements.motors_limited_twice),
        "limits of single motors on a tendon that limits their sum",
        "remove forcerange from the motors, or actuatorfrcrange from the tendon",
    ),
    _Feature(
        ("jax",),
        elements.named("body", elements.turning_bodies),
        "contacts of a body whose joints turn it almost about its center of mass",
        "move the body's joint or mass by a fifth of its size",
    ),
    _Feature(
        ("jax",),
        constraint_settings.solimps_without_width,
        "a solimp of width zero as MuJoCo does",
        "set its third number to more than zero",
    ),
    _Feature(
        ("jax",),
        elements.named("tendon", elements.side_sites_elsewhere),
        "a sidesite on another body than its geom",
        "move the site to the geom's body",
    ),
    _Feature(
        ("jax",),
        elements.named("actuator", lambda m: elements.any_of(m.actuator_damping, m.actuator_dampingpoly)),
        "actuator damping",
        "set damping on the joint",
    ),
    _Feature(
        ("jax",),
        elements.named("joint", elements.polynomial_joints),
        "polynomial stiffness and damping",
        "give the joint one stiffness and one damping",
    ),
    _Feature(
        ("jax",),
        elements.named("tendon", lambda m: elements.any_of(m.tendon_stiffnesspoly, m.tendon_dampingpoly)),
        "polynomial stiffness and damping",
        "give the tendon one stiffness and one damping",
    ),
    _Feature(
        ("jax",),
        elements.named("tendon", elements.branching_armatures),
        "the armature of a tendon across branches as MuJoCo does",
        "remove armature",
    ),
    _Feature(
        ("jax",),
        elements.named("geom", lambda m: elements.any_of(m.geom_adhesion)),
        "adhesion",
        "remove adhesion",
    ),
    _Feature(
        ("jax",),
        elements.named("pair", lambda m: elements.any_of(m.pair_adhesion)),
        "adhesion",
        "remove adhesion",
    ),
    _Feature(
        ("jax",),
        elements.named("geom", lambda m: elements.any_of(m.geom_surfacevel)),
        "moving surfaces",
        "remove surfacevel",
    ),
    _Feature(
        ("jax",),
        elements.named("geom", elements.fluid_geoms),
        "the fluid forces of individual geoms",
        "remove fluidshape and fluidcoef",
    ),
)
