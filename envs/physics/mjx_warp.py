"""The `warp` engine: MJX on MuJoCo Warp, for NVIDIA GPUs (and, slowly, for CPU tests)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from mujoco import mjx

from mjx_walk.envs.physics import capsule_frames_warp
from mjx_walk.envs.physics.base import Derived, PhysicsState, batch_once
from mjx_walk.envs.physics.mjx_model import read_derived, with_newton_solver

CONTACTS_PER_ENV = 40
"""Room for geom pairs that may touch, and then for contacts, of a copy on average; the batch shares both buffers.

Measured, highest mean over a batch: 20.7 pairs and 10.0 contacts (HumanoidStandup on the floor under random actions),
7.3 contacts under trained policies."""
SPARE_CONTACTS = 256
"""Room on top, so that a small batch, whose mean swings further, does not overflow."""
CONSTRAINTS_PER_ENV = 112
"""Constraint rows of any one copy: four for a contact with friction, one for any other and for a joint limit.

Measured: at most 49 under random actions, 31 under trained policies."""


class WarpEngine:
    """MuJoCo Warp in float32, called once a substep for the whole batch."""

    name = "warp"
    calls_host = False

    def __init__(self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]):
        capsule_frames_warp.install()
        # Without a GPU, Warp would warn that it has found none.
        wp.config.log_level = wp.LOG_ERROR if jax.default_backend() == "cpu" else wp.LOG_WARNING
        self._mj_model = with_newton_solver(model)
        # Warp would print two lines an overflow; it is returned instead, and counted in the metrics.
        self._model = mjx.put_model(self._mj_model, impl="warp", device=jax.local_devices()[0]).tree_replace(
            {"opt._impl.warn_overflow": 0}
        )
        last_model = self._model.tree_replace({"opt._impl.run_rne_postconstraint": "cfrc_ext" in derived})
        self._mjx_forward = _over_batch(mjx.forward, self._model)
        self._mjx_step = _over_batch(mjx.step, self._model)
        self._last_mjx_step = _over_batch(mjx.step, last_model)
        self._num_substeps = num_substeps
        self._derived = derived
        self.forward = batch_once(self._forward)
        self.step = batch_once(self._step)

    def _data(self, state: PhysicsState) -> mjx.Data:
        """Warp's work space for the whole batch, made inside the program: nearly all zeros, never a constant."""
        num_envs = state.qpos.shape[0]
        with jax.ensure_compile_time_eval():
            blank = mjx.make_data(
                self._mj_model,
                impl="warp",
                device=jax.local_devices()[0],
                naconmax=CONTACTS_PER_ENV * num_envs + SPARE_CONTACTS,
                njmax=CONSTRAINTS_PER_ENV,
            )
            blank = jax.tree.map(np.asarray, blank)
        blank = jax.tree.map(lambda x: jnp.array(x) if x.any() else jnp.zeros(x.shape, x.dtype), blank)
        return jax.vmap(lambda s: blank.replace(qpos=s.qpos, qvel=s.qvel, qacc_warmstart=s.qacc_warmstart))(state)

    def _forward(self, state: PhysicsState) -> Derived:
        return read_derived(self._mjx_forward(self._data(state)), self._derived)

    def _step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, Derived, jax.Array]:
        data = self._data(state).replace(ctrl=ctrl)
        overflow = lost_rows = jnp.zeros(ctrl.shape[0], bool)
        for substep in range(self._num_substeps):
            is_last = substep == self._num_substeps - 1
            data = self._last_mjx_step(data) if is_last else self._mjx_step(data)
            # The buffer is shared: once it is full, any copy may have lost a contact.
            # Pairs that do not fit are dropped before they become contacts, and `nacon` never shows it.
            most = jnp.maximum(data._impl.nacon, data._impl.ncollision)
            overflow |= (most > data._impl.naconmax).any()
            lost_rows |= data._impl.nefc > data._impl.njmax
        # Warp's solver does not survive lost rows: velocities explode. Such a copy is broken, and is marked as broken.
        qpos = jnp.where(lost_rows[:, None], jnp.nan, data.qpos)
        state = PhysicsState(qpos, data.qvel, data.qacc_warmstart)
        return state, read_derived(data, self._derived), overflow | lost_rows


_OnData = Callable[[mjx.Data], mjx.Data]


def _over_batch(function: Callable[[mjx.Model, mjx.Data], mjx.Data], model: mjx.Model) -> _OnData:
    """For a whole batch, and traced once: anew for each substep it would take a third of a chunk's tracing."""
    return jax.jit(jax.vmap(lambda data: function(model, data)), inline=True)
