"""The `c` engine: MuJoCo's C library in a host callback. It is fast on a CPU, and the reference for the others."""

import copy
import functools
import itertools
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

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


class _Workspace(NamedTuple):
    """Model and data of one thread."""

    model: mujoco.MjModel
    data: mujoco.MjData


class CEngine:
    """MuJoCo in float64 with the model's own solver. It equals Gymnasium's physics up to float32 rounding of the state.

    One thread per core steps a share of the environments. MuJoCo releases the GIL while it steps.
    """

    name = "c"
    calls_host = True

    def __init__(
        self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...], models: Mapping[str, np.ndarray]
    ):
        self._model = copy.copy(model)  # the MJX engines do not see later changes either
        self._models = models
        self._num_substeps = num_substeps
        self._state_names = PhysicsState._fields[: 4 if model.na else 3]
        self.preparation = Preparation()
        self._derived_shapes = derived_shapes(model, derived)
        self._num_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        # Threads write the values of changed models into a model of their own.
        copies = [copy.copy(model) if models else self._model for _ in range(self._num_threads)]
        self._workspaces = [_Workspace(one, mujoco.MjData(one)) for one in copies]
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(self._num_threads, thread_name_prefix="mujoco")
        self.forward = batch_once(self._forward)
        self.step = batch_once(self._step)

    def _forward(self, state: PhysicsState) -> Derived:
        _, derived, _ = self._result_shapes(len(state.qpos))
        return jax.pure_callback(self._host_forward, derived, state)

    def _step(
        self, state: PhysicsState, ctrl: Float[Array, "B *substeps nu"]
    ) -> tuple[PhysicsState, Derived, Bool[Array, " B"]]:
        shapes = self._result_shapes(len(ctrl))
        next_state, derived, overflow = jax.pure_callback(self._host_step, shapes, state, ctrl)
        return PhysicsState(*next_state)._replace(model_index=state.model_index), derived, overflow

    def _result_shapes(self, num_envs: int) -> tuple[tuple[_Shape, ...], dict[str, _Shape], _Shape]:
        """Shapes of what `_step` returns."""
        float32 = functools.partial(jax.ShapeDtypeStruct, dtype=np.float32)
        sizes = [np.size(getattr(self._workspaces[0].data, name)) for name in self._state_names]
        state = tuple(float32((num_envs, size)) for size in sizes)
        derived = {name: float32((num_envs, *shape)) for name, shape in self._derived_shapes.items()}
        return state, derived, jax.ShapeDtypeStruct((num_envs,), np.bool_)

    def _host_forward(self, state: PhysicsState) -> dict[str, np.ndarray]:
        state = jax.tree.map(np.asarray, state)
        derived = self._empty_derived(len(state.qpos))
        self._for_each_env(len(state.qpos), functools.partial(self._forward_one, state, derived))
        return derived

    def _forward_one(self, state: PhysicsState, derived: dict[str, np.ndarray], space: _Workspace, i: int) -> None:
        mujoco.mj_resetData(space.model, space.data)  # clears cfrc_ext, which mj_forward does not compute
        self._load_state(state, space, i)
        mujoco.mj_forward(space.model, space.data)
        self._store_derived(derived, space.data, i)

    def _host_step(
        self, state: PhysicsState, ctrl: np.ndarray
    ) -> tuple[tuple[np.ndarray, ...], dict[str, np.ndarray], np.ndarray]:
        state, ctrl = jax.tree.map(np.asarray, state), np.asarray(ctrl)
        next_state = tuple(np.empty(getattr(state, name).shape, np.float32) for name in self._state_names)
        derived = self._empty_derived(len(ctrl))
        self._for_each_env(len(ctrl), functools.partial(self._step_one, state, ctrl, next_state, derived))
        return next_state, derived, np.zeros(len(ctrl), np.bool_)  # `load_model` refuses models with too little memory

    def _step_one(
        self,
        state: PhysicsState,
        ctrl: np.ndarray,
        next_state: tuple[np.ndarray, ...],
        derived: dict[str, np.ndarray],
        space: _Workspace,
        i: int,
    ) -> None:
        model, data = space
        self._load_state(state, space, i)
        controls = ctrl[i] if ctrl.ndim == 3 else ctrl[i : i + 1]
        for control in controls:
            data.ctrl[:] = control
            mujoco.mj_step(model, data, nstep=self._num_substeps // len(controls))
        mujoco.mj_rnePostConstraint(model, data)
        for name, target in zip(self._state_names, next_state, strict=True):
            target[i] = getattr(data, name)
        self._store_derived(derived, data, i)
        if data.warning.number[_BAD_STATE].any():
            # MuJoCo has detected an invalid state and has reset itself. The MJX engines return NaN instead.
            for target in next_state:
                target[i] = np.nan
            mujoco.mj_resetData(model, data)

    def _load_state(self, state: PhysicsState, space: _Workspace, i: int) -> None:
        """Copy the state of environment i to the workspace's data, and the values of its model to its model."""
        if state.model_index is not None:
            for name, values in self._models.items():
                getattr(space.model, name)[:] = values[state.model_index[i]]
        for name in self._state_names:
            getattr(space.data, name)[:] = getattr(state, name)[i]

    def _empty_derived(self, num_envs: int) -> dict[str, np.ndarray]:
        return {name: np.empty((num_envs, *shape), np.float32) for name, shape in self._derived_shapes.items()}

    def _store_derived(self, derived: dict[str, np.ndarray], data: mujoco.MjData, i: int) -> None:
        for name, array in derived.items():
            array[i] = getattr(data, name)

    def _for_each_env(self, num_envs: int, function: Callable[[_Workspace, int], None]) -> None:
        """Call `function(workspace, i)` for every environment i, in several threads if there are enough of them."""
        num_threads = max(1, min(self._num_threads, num_envs // _MIN_ENVS_PER_THREAD))
        bounds = np.linspace(0, num_envs, num_threads + 1).astype(int)
        ranges = [range(start, stop) for start, stop in itertools.pairwise(bounds)]
        run = functools.partial(_for_range, function)
        with self._lock:  # several threads may step environments of one engine
            list((map if num_threads == 1 else self._pool.map)(run, self._workspaces, ranges))


def _for_range(function: Callable[[_Workspace, int], None], space: _Workspace, indices: range) -> None:
    for i in indices:
        function(space, i)
