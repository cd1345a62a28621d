"""Changes of a model that make MJX's JAX implementation simulate it as MuJoCo's C library does."""

import mujoco

__all__ = ["adapt_model"]

_SPRING = int(mujoco.mjtDisableBit.mjDSBL_SPRING)
_DAMPER = int(mujoco.mjtDisableBit.mjDSBL_DAMPER)


def adapt_model(model: mujoco.MjModel) -> None:
    """Change a copy of a model for MJX's JAX implementation."""
    _apply_spring_and_damper_flags(model)
    _raise_friction(model)
    if not (model.opt.density > 0 or model.opt.viscosity > 0):
        model.opt.wind[:] = 0  # no effect in C; MJX refuses it with an implicit integrator


def _apply_spring_and_damper_flags(model: mujoco.MjModel) -> None:
    """Set the coefficients to zero that a disabled flag leaves out, so that MJX needs no flag.

    MJX 3.17 leaves out all passive forces if one of the two flags is disabled; C does so only if both are. MJX's Euler
    integrator treats joint damping as implicit even if `damper` is disabled.
    """
    disabled = model.opt.disableflags & (_SPRING | _DAMPER)
    if disabled & _SPRING:
        model.jnt_stiffness[:] = 0
        model.tendon_stiffness[:] = 0
    if disabled & _DAMPER:
        model.dof_damping[:] = 0
        model.tendon_damping[:] = 0
    if disabled != _SPRING | _DAMPER:
        model.opt.disableflags &= ~(_SPRING | _DAMPER)


def _raise_friction(model: mujoco.MjModel) -> None:
    """Raise friction coefficients to C's least one. MJX divides by them."""
    for friction in (model.geom_friction, model.pair_friction):
        friction[:] = friction.clip(min=mujoco.mjMINMU)
