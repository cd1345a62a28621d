"""The `c` engine: MuJoCo's C library, called back from the jitted program. Fast on a CPU, and the oracle."""

import os
from concurrent.futures import ThreadPoolExecutor

import jax
import mujoco
import numpy as np

from mjx_walk.envs.physics.base import Derived, PhysicsState, batch_once

_BAD_STATE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{array}")) for array in ("QPOS", "QVEL", "QACC")]
_MIN_COPIES_PER_TASK = 8
"""Below this a thread's start costs more than it saves."""


class CEngine:
    """MuJoCo in float64 with the model's own solver: Gymnasium's physics to float32 rounding of the state.

    The copies are shared out over one thread a core; MuJoCo releases Python's lock while it steps.
    """

    name = "c"
    calls_host = True

    def __init__(self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]):
        self._model = model
        self._num_substeps = num_substeps
        self._derived = derived
        blank = mujoco.MjData(model)
        self._shapes = {name: np.shape(getattr(blank, name)) for name in derived}
        self._num_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._workspaces = [mujoco.MjData(model) for _ in range(self._num_threads)]
        self._pool = ThreadPoolExecutor(self._num_threads, thread_name_prefix="mujoco")
        self.forward = batch_once(self._forward)
        self.step = batch_once(self._step)

    def _forward(self, state: PhysicsState) -> Derived:
        result = self._result_shapes(len(state.qpos))[1]
        return jax.pure_callback(self._host_forward, result, *state)

    def _step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, Derived, jax.Array]:
        result = self._result_shapes(len(ctrl))
        next_state, derived, overflow = jax.pure_callback(self._host_step, result, *state, ctrl)
        return PhysicsState(*next_state), derived, overflow

    def _result_shapes(self, num_envs: int):
        def array(*shape, dtype=np.float32):
            return jax.ShapeDtypeStruct((num_envs, *shape), dtype)

        state = (array(self._model.nq), array(self._model.nv), array(self._model.nv))
        return state, {name: array(*shape) for name, shape in self._shapes.items()}, array(dtype=np.bool_)

    def _host_forward(self, qpos, qvel, warmstart) -> dict[str, np.ndarray]:
        qpos, qvel, warmstart = (np.asarray(x, np.float64) for x in (qpos, qvel, warmstart))
        derived = self._empty_derived(len(qpos))

        def one(data: mujoco.MjData, i: int) -> None:
            mujoco.mj_resetData(self._model, data)  # clears cfrc_ext, which mj_forward leaves alone
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos[i], qvel[i], warmstart[i]
            mujoco.mj_forward(self._model, data)
            self._store(data, derived, i)

        self._for_each_copy(len(qpos), one)
        return derived

    def _host_step(self, qpos, qvel, warmstart, ctrl):
        qpos, qvel, warmstart, ctrl = (np.asarray(x, np.float64) for x in (qpos, qvel, warmstart, ctrl))
        state = tuple(np.empty(x.shape, np.float32) for x in (qpos, qvel, warmstart))
        derived = self._empty_derived(len(qpos))

        def one(data: mujoco.MjData, i: int) -> None:
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos[i], qvel[i], warmstart[i]
            data.ctrl[:] = ctrl[i]
            mujoco.mj_step(self._model, data, nstep=self._num_substeps)
            mujoco.mj_rnePostConstraint(self._model, data)
            for target, source in zip(state, (data.qpos, data.qvel, data.qacc_warmstart), strict=True):
                target[i] = source
            self._store(data, derived, i)
            if data.warning.number[_BAD_STATE].any():
                # MuJoCo met a bad state, reset itself and went on. Say so as the MJX engines do.
                for target in state:
                    target[i] = np.nan
                mujoco.mj_resetData(self._model, data)

        self._for_each_copy(len(qpos), one)
        return state, derived, np.zeros(len(qpos), np.bool_)

    def _empty_derived(self, num_envs: int) -> dict[str, np.ndarray]:
        return {name: np.empty((num_envs, *shape), np.float32) for name, shape in self._shapes.items()}

    def _store(self, data: mujoco.MjData, derived: dict[str, np.ndarray], i: int) -> None:
        for name, target in derived.items():
            target[i] = getattr(data, name)

    def _for_each_copy(self, num_envs: int, one) -> None:
        num_tasks = max(1, min(self._num_threads, num_envs // _MIN_COPIES_PER_TASK))
        bounds = np.linspace(0, num_envs, num_tasks + 1).astype(int)

        def run(task: int) -> None:
            for i in range(bounds[task], bounds[task + 1]):
                one(self._workspaces[task], i)

        if num_tasks == 1:
            run(0)
        else:
            list(self._pool.map(run, range(num_tasks)))
