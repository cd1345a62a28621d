"""The arrays of `mjData` that a task may read on each engine. Others are refused by name, before compilation.

An array is allowed where it equals MuJoCo's C library's at Gymnasium's moment: after `mj_step` and
`mj_rnePostConstraint`, and at a reset after `mj_forward`. `tests/derived_arrays.py` compares them all.
"""

from collections.abc import Iterator

import mujoco
import numpy as np

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import near_misses

__all__ = ["LATE_ARRAYS", "derived_shapes", "fills_late_arrays", "refuse_derived"]

LATE_ARRAYS = ("cacc", "cfrc_int", "cfrc_ext")
"""Arrays that `mj_rnePostConstraint` fills. `mj_forward` calls it only for some sensors."""

_SENSOR_ARRAYS = ("sensordata", "subtree_linvel", "subtree_angmom")
"""Arrays that MuJoCo fills for sensors only, and with RK4 in the first stage only."""

_EVERY = {
    *("qpos", "qvel", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat"),
    *("qacc", "act", "act_dot", "userdata", "xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis"),
    *("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "subtree_com", "cdof", "cinert"),
    *("crb", "ten_length", "ten_velocity", "actuator_length", "actuator_velocity", "actuator_force", "cvel"),
    *("cdof_dot", "qfrc_bias", "qfrc_gravcomp", "qfrc_passive", "qfrc_actuator", "qfrc_smooth"),
    *("qacc_smooth", "qfrc_constraint", *LATE_ARRAYS, *_SENSOR_ARRAYS),
}
_NOT_JAX = {
    *("M", "qfrc_spring", "qfrc_damper", "qfrc_adhesion", "light_xpos", "light_xdir", "ten_J", "ten_wrapadr"),
    *("ten_wrapnum", "moment_rownnz", "qfrc_fluid"),
}
_ORDERED_BY_CHANCE = {"actuator_moment", "moment_rowadr", "moment_colind"}
"""Sparse rows that Warp's threads on a GPU place in the order in which they get there."""
_ONLY_C = {
    *("qLD", "qLDiagInv", "qH", "qHDiagInv", "qDeriv", "qLU", "qfrc_inverse", "energy", "solver_fwdinv"),
    *("flexvert_xpos", "flexelem_aabb", "flexedge_J", "flexedge_length", "flexedge_velocity"),
    *("flexvert_J", "flexvert_length", *_ORDERED_BY_CHANCE),
}
_MISSING = {"c": frozenset(), "warp": _ONLY_C, "jax": _ONLY_C | _NOT_JAX}
"""Arrays that an engine lacks, or stores in another layout."""

_FROM_EARLIER_STEPS = {"time", "wrap_obj", "wrap_xpos", "solver_niter", "solver_nnz", "flexvert_lambda"}
"""Values that depend on more than `PhysicsState` holds."""

_Sensor = mujoco.mjtSensor
_RNE_SENSORS = (
    *(_Sensor.mjSENS_ACCELEROMETER, _Sensor.mjSENS_FORCE, _Sensor.mjSENS_TORQUE),
    *(_Sensor.mjSENS_FRAMELINACC, _Sensor.mjSENS_FRAMEANGACC),
)
_OTHER_SENSORS = {
    "warp": (_Sensor.mjSENS_GEOMDIST, _Sensor.mjSENS_GEOMNORMAL, _Sensor.mjSENS_GEOMFROMTO),
    "jax": (_Sensor.mjSENS_CONTACT, _Sensor.mjSENS_RANGEFINDER),
}
"""Sensors that MJX computes otherwise than MuJoCo."""


def derived_shapes(model: mujoco.MjModel, names: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Shapes of derived arrays, which are the same on every engine."""
    blank = mujoco.MjData(model)
    return {name: np.shape(getattr(blank, name)) for name in names}


def fills_late_arrays(model: mujoco.MjModel) -> bool:
    """Whether `mj_forward` fills `LATE_ARRAYS`, because a sensor needs them."""
    is_enabled = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR
    return bool(is_enabled and np.isin(model.sensor_type, _RNE_SENSORS).any())


def refuse_derived(model: mujoco.MjModel, engine: str, names: tuple[str, ...]) -> None:
    """Check that an engine returns the arrays that a task names.

    Args:
        model: the MuJoCo model.
        engine: name of the engine.
        names: of the arrays.

    Raises:
        UserError: it does not; the message names the first array.
    """
    for name in names:
        for reason in _reasons(model, engine, name):
            raise UserError(f"{reason}; the task names '{name}' in derived_names")


def _reasons(model: mujoco.MjModel, engine: str, name: str) -> Iterator[str]:
    """Why an engine cannot return an array as MuJoCo does, if it cannot."""
    if name not in _EVERY | _NOT_JAX | _ONLY_C:
        yield _unknown(model, name)
    if name == "sensordata":
        for sensor in _sensors(model, (_Sensor.mjSENS_CLOCK,)):
            yield f"{sensor} reads the time, which no engine keeps; remove it"
    if engine == "c":
        return
    if name in _MISSING[engine]:
        others = "c" if name in _ONLY_C else "warp or c"
        yield f"physics={engine} does not return mjData's '{name}' as MuJoCo does; use physics={others}"
    if name == "sensordata":
        for sensor in _sensors(model, _OTHER_SENSORS[engine]):
            yield f"physics={engine} computes {sensor} otherwise than MuJoCo; use physics=c, or remove it"
        if engine == "warp":
            for sensor in _sensors(model, (_Sensor.mjSENS_CONTACT,), _keeps_every_contact(model)):
                yield f"physics=warp gives the contacts of {sensor} in no fixed order; set its reduce, or use physics=c"
    if name in _SENSOR_ARRAYS and model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        yield 'MJX computes sensors at another stage of RK4 than MuJoCo; use integrator="Euler" or physics=c'
    if name == "act_dot" and engine == "warp" and model.na and model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        yield "physics=warp returns another 'act_dot' than MuJoCo with RK4; use physics=jax or c"
    is_late = name in LATE_ARRAYS or (name == "sensordata" and fills_late_arrays(model))
    if engine == "jax" and is_late and model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT:
        yield f"physics=jax does not compute '{name}' without constraints; remove the flag, or use physics=warp or c"
    if engine == "jax" and name in ("cfrc_int", "cfrc_ext") and _has_spatial_tendon(model):
        yield f"physics=jax leaves the forces of spatial tendons out of '{name}'; use physics=warp or c"


def _unknown(model: mujoco.MjModel, name: str) -> str:
    """The error for a name that no engine returns."""
    if name in _FROM_EARLIER_STEPS:
        return f"mjData's '{name}' depends on earlier steps, which no engine keeps"
    if name in dir(mujoco.MjData):
        return f"no engine returns mjData's '{name}'; it is no array of fixed size that describes the simulated state"
    near = near_misses(name, sorted(_EVERY | _NOT_JAX | _ONLY_C))
    return f"MuJoCo's mjData has no array '{name}'" + (f" (did you mean: {', '.join(near)}?)" if near else "")


def _sensors(
    model: mujoco.MjModel, kinds: tuple[mujoco.mjtSensor, ...], where: np.ndarray | bool = True
) -> Iterator[str]:
    """The sensors of these kinds, of those that `where` marks."""
    for i in np.flatnonzero(np.isin(model.sensor_type, kinds) & where):
        yield f"sensor '{model.sensor(int(i)).name or i}'"


def _keeps_every_contact(model: mujoco.MjModel) -> np.ndarray:
    """Contact sensors that list contacts in the order of `mjData`, and read more of them than how many there are."""
    fields, reduce, _ = model.sensor_intprm.T
    return (reduce == 0) & (fields != 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND))


def _has_spatial_tendon(model: mujoco.MjModel) -> bool:
    return bool((model.wrap_type[model.tendon_adr] != mujoco.mjtWrap.mjWRAP_JOINT).any())
