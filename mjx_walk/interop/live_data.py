"""Gymnasium's `data`: MuJoCo's arrays at the last step, computed when they are read."""

import copy
from collections.abc import Callable
from typing import Any, NamedTuple, SupportsIndex

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_walk.envs import Task
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.randomization.episode import Draws
from mjx_walk.utils.errors import UserError

__all__ = ["LiveData", "Moment", "Start", "fill"]

_SIGNATURES = {
    "time": mujoco.mjtState.mjSTATE_TIME,
    "qpos": mujoco.mjtState.mjSTATE_QPOS,
    "qvel": mujoco.mjtState.mjSTATE_QVEL,
    "act": mujoco.mjtState.mjSTATE_ACT,
    "qacc_warmstart": mujoco.mjtState.mjSTATE_WARMSTART,
    "ctrl": mujoco.mjtState.mjSTATE_CTRL,
    "qfrc_applied": mujoco.mjtState.mjSTATE_QFRC_APPLIED,
    "xfrc_applied": mujoco.mjtState.mjSTATE_XFRC_APPLIED,
    "eq_active": mujoco.mjtState.mjSTATE_EQ_ACTIVE,
    "mocap_pos": mujoco.mjtState.mjSTATE_MOCAP_POS,
    "mocap_quat": mujoco.mjtState.mjSTATE_MOCAP_QUAT,
    "userdata": mujoco.mjtState.mjSTATE_USERDATA,
}
"""Inputs of MuJoCo's simulation, by their `mjData` names."""


class Start(NamedTuple):
    """The start of a step."""

    physics: PhysicsState
    draws: Draws | None
    """Randomness of the episode."""
    steps: Array
    """`[] i32`: steps since the reset."""


class Moment(NamedTuple):
    """The origin of `data`: a reset or a step, and a later `set_state`."""

    physics: PhysicsState | None = None
    """Physics state after the reset or step. None before the first reset."""
    start: Start | None = None
    """Start of the step. None: no step since the reset."""
    action: np.ndarray | None = None
    """`[nu] f32`, the action of the step."""
    placed: tuple[np.ndarray, np.ndarray] | None = None
    """Position `[nq] f64` and velocity `[nv] f64` of a later `set_state`."""


class LiveData(mujoco.MjData):
    """The `mujoco.MjData` of an environment. It follows the environment and cannot be written to.

    Reading an attribute refreshes all arrays if the environment has stepped since the last read. Copies are ordinary
    `MjData` that stay as they are and can be written to.
    """

    _model: mujoco.MjModel
    _read: Callable[[], Moment]
    _fill: Callable[[mujoco.MjData, Moment], None]
    _moment: Moment | None
    _inputs: dict[str, bytes]

    def __init__(
        self, model: mujoco.MjModel, read: Callable[[], Moment], fill: Callable[[mujoco.MjData, Moment], None]
    ):
        """
        Args:
            model: the model.
            read: gives the environment's last moment, the same object until the environment changes.
            fill: fills `MjData` with the arrays of a moment.
        """
        super().__init__(model)
        self.__dict__.update(_model=model, _read=read, _fill=fill, _moment=None, _inputs={})

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("_"):
            return super().__getattribute__(name)
        self._refresh()
        value = super().__getattribute__(name)
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        return value

    def __setattr__(self, name: str, value: object) -> None:
        """
        Raises:
            UserError: always.
        """
        raise UserError(f"the physics ignores your value of data.{name}; use set_state instead")

    def __copy__(self) -> mujoco.MjData:
        self._refresh()
        return super().__copy__()

    def __deepcopy__(self, memo: dict[int, object]) -> mujoco.MjData:
        return self.__copy__()

    def __reduce_ex__(
        self, protocol: SupportsIndex
    ) -> tuple[Callable[[mujoco.MjData], mujoco.MjData], tuple[mujoco.MjData]]:
        return copy.copy, (self.__copy__(),)

    def _refresh(self) -> None:
        """Fill the arrays if the environment has changed.

        Raises:
            UserError: the data have been changed.
        """
        moment = self._read()
        if moment is not self._moment:
            self._refuse_changes()
            self._fill(self, moment)
            self.__dict__.update(_moment=moment, _inputs=self._read_inputs())

    def _refuse_changes(self) -> None:
        """Check that nobody has changed the inputs, which named views and MuJoCo's functions write to.

        Raises:
            UserError: somebody has; names the first input. The next read restores them.
        """
        if self._moment is None:
            return
        found = self._read_inputs()
        for name, value in self._inputs.items():
            if found[name] != value:
                self.__dict__.update(_moment=None)
                raise UserError(f"the physics ignores your change to data.{name}; use set_state instead")

    def _read_inputs(self) -> dict[str, bytes]:
        return {name: _read_input(self._model, self, name).tobytes() for name in _SIGNATURES}


def fill(task: Task, model: mujoco.MjModel, data: mujoco.MjData, moment: Moment) -> None:
    """Fill data with what Gymnasium's hold at a moment.

    After a reset and after `set_state`, they are those of `mj_forward`. A step runs again in MuJoCo's C library, from
    the state before it. Its arrays are those of the last forward pass, at most one physics step older than the
    position. Position, velocity and activations are the engine's own, which on the MJX engines differ from those of C
    by float32 errors. Arrays of memory that MuJoCo has not written in the moment have no defined values, as in
    Gymnasium.

    Args:
        task: the task.
        model: its model, in its present appearance.
        data: of the model; all arrays are overwritten.
        moment: the moment.
    """
    mujoco.mj_resetData(model, data)
    physics, start, action, placed = moment
    if physics is not None:
        model = _randomized(task, model, physics)
        if start is not None and action is not None:
            _step(task, model, data, start, action)
        _write_inputs(model, data, qpos=physics.qpos, qvel=physics.qvel, act=physics.act)
    if placed is not None:
        _write_inputs(model, data, qpos=placed[0], qvel=placed[1])
    if placed is not None or (physics is not None and start is None):
        mujoco.mj_forward(model, data)


def _randomized(task: Task, model: mujoco.MjModel, physics: PhysicsState) -> mujoco.MjModel:
    """The model of the episode: a copy with other values if the task's models are randomized."""
    if physics.model_index is not None:
        model = model.__copy__()
        for name, values in task.randomizer.models.items():
            getattr(model, name)[:] = values[physics.model_index]
    return model


def _step(task: Task, model: mujoco.MjModel, data: mujoco.MjData, start: Start, action: np.ndarray) -> None:
    """Step as the `c` engine does, with pushes and late actions."""
    if start.draws is not None:  # it computes with JAX's arrays, which a copy of the environment lacks
        start = jax.tree.map(jnp.asarray, start)
    _, physics, control = jax.device_get(task.randomizer.disturb(start.draws, start.physics, jnp.asarray(action)))
    inputs = {name: getattr(physics, name) for name in ("qpos", "qvel", "act", "qacc_warmstart")}
    _write_inputs(model, data, time=np.asarray(start.steps) * task.dt, **inputs)
    controls = control.reshape(-1, model.nu)
    for one in controls:
        _write_inputs(model, data, ctrl=one)
        mujoco.mj_step(model, data, nstep=task.num_substeps() // len(controls))
    mujoco.mj_rnePostConstraint(model, data)


def _write_inputs(model: mujoco.MjModel, data: mujoco.MjData, **values: ArrayLike | None) -> None:
    """Write inputs by their names. It works for read-only arrays, too. None leaves an input unchanged."""
    for name, value in values.items():
        if value is not None:
            array = np.atleast_1d(np.asarray(value, np.float64))
            mujoco.mj_setState(model, data, array, _SIGNATURES[name])


def _read_input(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
    array = np.empty(mujoco.mj_stateSize(model, _SIGNATURES[name]), np.float64)
    mujoco.mj_getState(model, data, array, _SIGNATURES[name])
    return array
