"""The `c` engine: MuJoCo's C library in a host callback. It is fast on a CPU, and the reference for the others."""

import copy
import functools
import itertools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from mjx_walk.envs.physics.base import Derived, PhysicsState, batch_once
from mjx_walk.envs.physics.derived_arrays import derived_shapes
from mjx_walk.envs.physics.preparation import Preparation

__all__ = ["CEngine"]

_WARNING = mujoco.mjtWarning
_BAD_STATE = [int(_WARNING.mjWARN_BADQPOS), int(_WARNING.mjWARN_BADQVEL), int(_WARNING.mjWARN_BADQACC)]
_MIN_ENVS_PER_THREAD = 8
"""With fewer environments, starting a thread takes longer than it saves."""
_Shape = jax.ShapeDtypeStruct


class CEngine:
    """MuJoCo in float64 with the model's own solver. It equals Gymnasium's physics up to float32 rounding of the state.

    One thread per core steps a share of the environments. MuJoCo releases the GIL while it steps.
    """

    name = "c"
    calls_host = True

    def __init__(self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]):
        self._model = copy.copy(model)  # the MJX engines do not see later changes either
        self._num_substeps = num_substeps
        self._state_names = PhysicsState._fields if model.na else PhysicsState._fields[:3]
        self.preparation = Preparation()
        self._derived_shapes = derived_shapes(model, derived)
        self._num_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._workspaces = [mujoco.MjData(self._model) for _ in range(self._num_threads)]
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(self._num_threads, thread_name_prefix="mujoco")
        self.forward = batch_once(self._forward)
        self.step = batch_once(self._step)

    def _forward(self, state: PhysicsState) -> Derived:
        _, derived, _ = self._result_shapes(len(state.qpos))
        return jax.pure_callback(self._host_forward, derived, *jax.tree.leaves(state))

    def _step(self, state: PhysicsState, ctrl: Float[Array, "B nu"]) -> tuple[PhysicsState, Derived, Bool[Array, " B"]]:
        shapes = self._result_shapes(len(ctrl))
        next_state, derived, overflow = jax.pure_callback(self._host_step, shapes, *jax.tree.leaves(state), ctrl)
        return PhysicsState(*next_state), derived, overflow

    def _result_shapes(self, num_envs: int) -> tuple[tuple[_Shape, ...], dict[str, _Shape], _Shape]:
        """Shapes of what `_step` returns."""
        float32 = functools.partial(jax.ShapeDtypeStruct, dtype=np.float32)
        sizes = [np.size(getattr(self._workspaces[0], name)) for name in self._state_names]
        state = tuple(float32((num_envs, size)) for size in sizes)
        derived = {name: float32((num_envs, *shape)) for name, shape in self._derived_shapes.items()}
        return state, derived, jax.ShapeDtypeStruct((num_envs,), np.bool_)

    def _host_forward(self, *arrays: np.ndarray) -> dict[str, np.ndarray]:
        state = [np.asarray(x, np.float64) for x in arrays]
        derived = self._empty_derived(len(state[0]))
        self._for_each_env(len(state[0]), functools.partial(self._forward_one, state, derived))
        return derived

    def _forward_one(
        self, state: list[np.ndarray], derived: dict[str, np.ndarray], data: mujoco.MjData, i: int
    ) -> None:
        mujoco.mj_resetData(self._model, data)  # clears cfrc_ext, which mj_forward does not compute
        self._load_state(state, data, i)
        mujoco.mj_forward(self._model, data)
        self._store_derived(derived, data, i)

    def _host_step(self, *arrays: np.ndarray) -> tuple[tuple[np.ndarray, ...], dict[str, np.ndarray], np.ndarray]:
        *state, ctrl = (np.asarray(x, np.float64) for x in arrays)
        next_state = tuple(np.empty(x.shape, np.float32) for x in state)
        derived = self._empty_derived(len(ctrl))
        self._for_each_env(len(ctrl), functools.partial(self._step_one, state, ctrl, next_state, derived))
        return next_state, derived, np.zeros(len(ctrl), np.bool_)  # `load_model` refuses models with too little memory

    def _step_one(
        self,
        state: list[np.ndarray],
        ctrl: np.ndarray,
        next_state: tuple[np.ndarray, ...],
        derived: dict[str, np.ndarray],
        data: mujoco.MjData,
        i: int,
    ) -> None:
        self._load_state(state, data, i)
        data.ctrl[:] = ctrl[i]
        mujoco.mj_step(self._model, data, nstep=self._num_substeps)
        mujoco.mj_rnePostConstraint(self._model, data)
        for name, target in zip(self._state_names, next_state, strict=True):
            target[i] = getattr(data, name)
        self._store_derived(derived, data, i)
        if data.warning.number[_BAD_STATE].any():
            # MuJoCo has detected an invalid state and has reset itself. The MJX engines return NaN instead.
            for target in next_state:
                target[i] = np.nan
            mujoco.mj_resetData(self._model, data)

    def _load_state(self, state: list[np.ndarray], data: mujoco.MjData, i: int) -> None:
        """Copy the state of environment i to `data`."""
        for name, source in zip(self._state_names, state, strict=True):
            getattr(data, name)[:] = source[i]

    def _empty_derived(self, num_envs: int) -> dict[str, np.ndarray]:
        return {name: np.empty((num_envs, *shape), np.float32) for name, shape in self._derived_shapes.items()}

    def _store_derived(self, derived: dict[str, np.ndarray], data: mujoco.MjData, i: int) -> None:
        for name, array in derived.items():
            array[i] = getattr(data, name)

    def _for_each_env(self, num_envs: int, function: Callable[[mujoco.MjData, int], None]) -> None:
        """Call `function(data, i)` for every environment i, in several threads if there are enough environments."""
        num_threads = max(1, min(self._num_threads, num_envs // _MIN_ENVS_PER_THREAD))
        bounds = np.linspace(0, num_envs, num_threads + 1).astype(int)
        ranges = [range(start, stop) for start, stop in itertools.pairwise(bounds)]
        run = functools.partial(_for_range, function)
        with self._lock:  # several threads may step environments of one engine
            list((map if num_threads == 1 else self._pool.map)(run, self._workspaces, ranges))


def _for_range(function: Callable[[mujoco.MjData, int], None], data: mujoco.MjData, indices: range) -> None:
    for i in indices:
        function(data, i)
