"""The `warp` engine: MJX on MuJoCo Warp, for NVIDIA GPUs. It also runs on a CPU, slowly, for tests."""

import functools
from collections.abc import Callable, Mapping
from concurrent.futures import Future

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from jax import Array
from jaxtyping import Bool, Float
from mujoco import mjx

from mjx_walk.envs.physics import body_forces, capsule_frames_warp
from mjx_walk.envs.physics.base import Derived, PhysicsState, batch_once
from mjx_walk.envs.physics.derived_arrays import LATE_ARRAYS, derived_shapes, fills_late_arrays
from mjx_walk.envs.physics.elements import pairs_that_move
from mjx_walk.envs.physics.mjx_model import (
    chosen_values,
    mjx_values,
    read_derived,
    state_of,
    with_newton_solver,
    with_state,
)
from mjx_walk.envs.physics.preparation import Preparation
from mjx_walk.envs.physics.static_pairs import drop_static_pairs
from mjx_walk.envs.physics.warp_kernels import choose_cache, load_kernels
from mjx_walk.machine.devices import default_device

__all__ = ["CONSTRAINTS_PER_ENV", "CONTACTS_PER_ENV", "SPARE_CONTACTS", "WarpEngine", "warp_device"]

CONTACTS_PER_ENV = 40
"""Mean capacity per environment for candidate geom pairs, and for contacts. The batch shares both buffers.

The highest means over a batch were 20.7 pairs and 10.0 contacts under random actions (HumanoidStandup on the floor),
and 7.3 contacts under trained policies."""
SPARE_CONTACTS = 256
"""Additional capacity for the batch, since the mean of a small batch varies more."""
CONSTRAINTS_PER_ENV = 112
"""Capacity of each environment for constraint rows. A contact takes four with friction, else one; a joint limit one.

The highest counts were 49 under random actions and 31 under trained policies. Only the humanoids can exceed these
buffers at all. With every pair of geoms in contact, Ant, the largest of the others, has 13 pairs, 25 contacts and 108
rows; under random actions it had 2.0 pairs and 0.6 contacts on average, and 26 rows."""


class WarpEngine:
    """MuJoCo Warp in float32, called once per substep for the entire batch."""

    name = "warp"
    calls_host = False

    def __init__(
        self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...], models: Mapping[str, np.ndarray]
    ):
        choose_cache()
        capsule_frames_warp.install()
        # On a CPU, this hides Warp's warning about a missing GPU.
        wp.config.log_level = wp.LOG_ERROR if jax.default_backend() == "cpu" else wp.LOG_WARNING
        self._mj_model = with_newton_solver(model)
        drop_static_pairs(self._mj_model)
        _use_mujocos_boxes(self._mj_model)
        # `step` returns overflows, so Warp need not print them.
        self._model = mjx.put_model(self._mj_model, impl="warp", device=default_device()).tree_replace(
            {"opt._impl.warn_overflow": 0}
        )
        last_model = self._model.tree_replace(
            {"opt._impl.run_rne_postconstraint": any(x in LATE_ARRAYS for x in derived)}
        )
        self._mjx_forward = _over_batch(mjx.forward, self._model)
        self._mjx_step = _over_batch(mjx.step, self._model)
        self._last_mjx_step = _over_batch(mjx.step, last_model)
        self._num_substeps = num_substeps
        self._values = mjx_values(self._model, models)
        # Equality constraints and frictional joints have a row each in every step, unlike contacts and limits.
        with_friction = np.count_nonzero(model.dof_frictionloss) + np.count_nonzero(model.tendon_frictionloss)
        self._njmax = CONSTRAINTS_PER_ENV + model.neq + int(with_friction)
        self._derived = derived_shapes(model, derived)
        self._body_forces = [name for name in body_forces.OUTPUTS if name in derived]
        self.preparation = Preparation(self._load_kernels)
        self.forward = batch_once(self._forward)
        self.step = batch_once(self._step)

    def _load_kernels(self) -> list[Future]:
        return load_kernels(self._mj_model, self._njmax, warp_device(default_device()))

    def _data(self, state: PhysicsState) -> mjx.Data:
        """Warp's data for the entire batch.

        Most arrays are zeros. The program allocates them itself instead of holding them as constants.
        """
        self.preparation.before_trace()
        num_envs = state.qpos.shape[0]
        with jax.ensure_compile_time_eval():
            blank = mjx.make_data(
                self._mj_model,
                impl="warp",
                device=default_device(),
                naconmax=CONTACTS_PER_ENV * num_envs + SPARE_CONTACTS,
                njmax=self._njmax,
            )
            blank = jax.tree.map(np.asarray, blank)
        blank = jax.tree.map(lambda x: jnp.array(x) if x.any() else jnp.zeros(x.shape, x.dtype), blank)
        return jax.vmap(functools.partial(with_state, blank))(state)

    def _forward(self, state: PhysicsState) -> Derived:
        values = chosen_values(self._values, state.model_index)
        data = self._mjx_forward(values, self._data(state)).replace(qpos=state.qpos)  # MJX normalizes its quaternions
        derived = read_derived(data, self._derived, state.qpos.shape[:1])
        if fills_late_arrays(self._mj_model):
            return derived
        # Warp uses these for the bias forces.
        return derived | {name: jnp.zeros_like(derived[name]) for name in self._body_forces}

    def _step(
        self, state: PhysicsState, ctrl: Float[Array, "B *substeps nu"]
    ) -> tuple[PhysicsState, Derived, Bool[Array, " B"]]:
        values = chosen_values(self._values, state.model_index)
        used = self._used_control(ctrl)
        data = self._data(state).replace(ctrl=used if used.ndim == 2 else used[:, 0])
        overflow = lost_rows = jnp.zeros(ctrl.shape[0], bool)
        for substep in range(self._num_substeps):
            is_last = substep == self._num_substeps - 1
            if used.ndim == 3:
                data = data.replace(ctrl=used[:, substep])
            data = (self._last_mjx_step if is_last else self._mjx_step)(values, data)
            # All environments share the buffers, so any of them may have lost a contact.
            # `nacon` does not count the pairs that Warp drops before it computes contacts.
            num_needed = jnp.maximum(data._impl.nacon, data._impl.ncollision)
            overflow |= (num_needed > data._impl.naconmax).any()
            lost_rows |= data._impl.nefc > data._impl.njmax
        data = data.replace(ctrl=ctrl if ctrl.ndim == 2 else ctrl[:, -1])
        # Velocities diverge once constraint rows are lost, so the task must end these episodes as not finite.
        state = state_of(data, state.model_index)
        state = state._replace(qpos=jnp.where(lost_rows[:, None], jnp.nan, state.qpos))
        return state, self._read_after_step(data), overflow | lost_rows

    def _used_control(self, ctrl: Float[Array, "B *substeps nu"]) -> Float[Array, "B *substeps nu"]:
        """The control, clipped for an implicit integrator. Warp clips it in forces, but not in their derivatives."""
        model = self._mj_model
        is_explicit = model.opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if is_explicit or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
            return ctrl
        return jnp.where(model.actuator_ctrllimited.astype(bool), jnp.clip(ctrl, *model.actuator_ctrlrange.T), ctrl)

    def _read_after_step(self, data: mjx.Data) -> Derived:
        derived = read_derived(data, self._derived, data.qvel.shape[:1])
        if not self._body_forces:
            return derived
        shapes = derived_shapes(self._mj_model, body_forces.INPUTS)
        forces = body_forces.body_forces(self._mj_model, read_derived(data, shapes, data.qvel.shape[:1]), data.qvel)
        return derived | {name: forces[name] for name in self._body_forces}


def _use_mujocos_boxes(model: mujoco.MjModel) -> None:
    """Make Warp find contacts of two boxes as MuJoCo does, if boxes may touch. This is all that the flag does in Warp.

    Largest errors of velocities after a step of a box on a box, relative to one plus their change, with a penetration
    of 2, 10 and 50 mm: 6.5e-2, 0.22 and 2.9 by Warp's default. With the flag they are at most 8.6e-6.
    """
    geoms, _ = pairs_that_move(model)
    if (model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_BOX).all(axis=1).any():
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD


def warp_device(device: jax.Device) -> wp.Device:
    """Warp's device for a device of this process.

    Deviation: `wp.device_from_jax` takes `id`, which is another GPU, or none, in every process but the first.
    """
    return wp.get_device("cpu") if device.platform == "cpu" else wp.get_cuda_device(device.local_hardware_id)


def _over_batch(
    function: Callable[[mjx.Model, mjx.Data], mjx.Data], model: mjx.Model
) -> Callable[[dict[str, Array], mjx.Data], mjx.Data]:
    """Batch a function of changed values of a model, which may be none, and of MJX data.

    `jit` caches its trace. Tracing it in every substep would take a third of the tracing time of a training call.
    """
    return jax.jit(jax.vmap(functools.partial(_with_values, function, model)), inline=True)


def _with_values(
    function: Callable[[mjx.Model, mjx.Data], mjx.Data], model: mjx.Model, values: dict[str, Array], data: mjx.Data
) -> mjx.Data:
    return function(model.tree_replace(values) if values else model, data)
