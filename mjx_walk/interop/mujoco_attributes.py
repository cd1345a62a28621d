"""Attributes of Gymnasium's MuJoCo environments that other code reads: the model, times, state and frames.

Each environment holds one of Gymnasium, which draws resets and renders, and is never stepped.
"""

import inspect
from typing import Any, Generic, TypeVar

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer, OffScreenViewer
from gymnasium.envs.registration import load_env_creator

from mjx_walk.envs import TASKS, State, Task, TaskOptions
from mjx_walk.envs.ground.options import Ground
from mjx_walk.envs.model_changes import ModelSnapshot
from mjx_walk.interop.live_data import LiveData, Moment, fill
from mjx_walk.machine.opengl import has_screen
from mjx_walk.machine.quiet_mujoco import hide_deprecations
from mjx_walk.utils.errors import UserError

__all__ = ["RENDER_KEYWORDS", "RENDER_MODES", "MujocoAttributes", "make_gymnasium_env", "split_keywords"]

RENDER_KEYWORDS = (
    "render_mode",
    "width",
    "height",
    "camera_id",
    "camera_name",
    "default_camera_config",
    "max_geom",
    "visual_options",
)
"""Gymnasium's keywords that concern frames."""

_SETTABLE = (
    "metadata",
    "render_mode",
    "observation_space",
    "action_space",
    "spec",
    "init_qpos",
    "init_qvel",
    "_np_random",
    "_np_random_seed",
)
"""Attributes of Gymnasium's environments that have their meaning here as well when they are set."""

RENDER_MODES = ("human", "rgb_array", "depth_array", "rgbd_tuple")

_Value = TypeVar("_Value")


def split_keywords(keywords: dict[str, object]) -> tuple[dict[str, object], dict[str, object]]:
    """Keywords of the task, and those of `RENDER_KEYWORDS`."""
    rendering = {name: value for name, value in keywords.items() if name in RENDER_KEYWORDS}
    return {name: value for name, value in keywords.items() if name not in rendering}, rendering


def make_gymnasium_env(options: TaskOptions, rendering: dict[str, object]) -> MujocoEnv:
    """Gymnasium's own environment, without wrappers.

    Args:
        options: env options.
        rendering: values of `RENDER_KEYWORDS`.

    Raises:
        UserError: Gymnasium has no equivalent or no such ground, or `render_mode="human"` without a screen, with which
            Gymnasium ends the process.
    """
    if not TASKS[options.name][0].has_gymnasium_name():
        raise UserError(f"Gymnasium has no equivalent of {options.name}; step it with mjx_walk.make_env")
    if options.ground != Ground():
        raise UserError("Gymnasium's floor is flat; leave ground out, or step the hills with mjx_walk.make_env")
    if rendering.get("render_mode") == "human" and not has_screen():
        raise UserError("render_mode='human' needs a screen; use render_mode='rgb_array'")
    spec = gymnasium.spec(TASKS[options.name][0].id_of(options))
    create: Any = load_env_creator(str(spec.entry_point))
    with hide_deprecations():
        return create(**spec.kwargs | options.gymnasium_kwargs() | rendering)


class _Forwarded(Generic[_Value]):
    """An attribute that Gymnasium's environment holds."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, env: "MujocoAttributes", owner: type) -> _Value:
        return getattr(env._gymnasium_env, self._name)

    def __set__(self, env: "MujocoAttributes", value: _Value) -> None:
        setattr(env._gymnasium_env, self._name, value)


class MujocoAttributes:
    """The attributes of Gymnasium's `MujocoEnv`.

    The physics reads only the state of `set_state` and, at resets of a single environment, `init_qpos` and `init_qvel`.
    Other changes are refused.
    """

    _gymnasium_env: MujocoEnv
    _snapshot: ModelSnapshot
    _task: Task
    _data: LiveData | None = None
    _read_data: list[LiveData]
    render_mode: str | None

    model = _Forwarded[mujoco.MjModel]()
    """A copy of the MuJoCo model, from which frames are rendered. Changes of its physics are refused."""
    dt = _Forwarded[float]()
    """Duration of a step, s."""
    frame_skip = _Forwarded[int]()
    init_qpos = _Forwarded[np.ndarray]()
    """`[nq] f64`, m and rad: the pose to which resets add noise."""
    init_qvel = _Forwarded[np.ndarray]()
    """`[nv] f64`, m/s and rad/s."""
    observation_structure = _Forwarded[dict[str, int]]()
    """Sizes of the observation's parts, of the tasks for which Gymnasium defines them."""
    width = _Forwarded[int]()
    height = _Forwarded[int]()
    camera_id = _Forwarded[int | None]()
    camera_name = _Forwarded[str | None]()

    def __setattr__(self, name: str, value: object) -> None:
        """Set an attribute of the environment.

        Raises:
            UserError: Gymnasium's environment reads the attribute, and this one does not.
        """
        gymnasium_env = getattr(self, "_gymnasium_env", None)  # None while the environment is built
        is_read = gymnasium_env is not None and (name in vars(gymnasium_env) or hasattr(type(gymnasium_env), name))
        if is_read and name not in _SETTABLE and not hasattr(gymnasium.Env, name):
            instead = {"model": "; use xml_file=PATH instead", "data": "; use set_state instead"}
            if callable(getattr(type(gymnasium_env), name, None)):
                instead[name] = "; write a task of your own instead"
            keyword = name.removeprefix("_")
            if keyword in (*inspect.signature(type(gymnasium_env)).parameters, *RENDER_KEYWORDS):
                instead[name] = f"; give {keyword}=… to gymnasium.make instead"
            raise UserError(f"the environment ignores your value of {name}{instead.get(name, '')}")
        super().__setattr__(name, value)

    def _read_state(self) -> State | None:
        """State of this environment; None before the first reset."""
        raise NotImplementedError

    def _read_moment(self) -> Moment:
        """The origin of `data`, the same object until it changes."""
        raise NotImplementedError

    def _write_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        raise NotImplementedError

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's arrays, one object that follows the environment, as in Gymnasium. Writes to it are refused.

        They are computed when they are read, by MuJoCo's C library on every engine; see `live_data.fill`. An array that
        is kept changes when `data` is read after the next step, so copy it.

        Raises:
            UserError: the model or the data have been changed.
        """
        if self._data is None:
            self._data = LiveData(self.model, self._read_moment, self._fill)
            self._read_data.append(self._data)
        self._data._refresh()
        return self._data

    def _fill(self, data: mujoco.MjData, moment: Moment) -> None:
        self._snapshot.refuse_changes()
        fill(self._task, self.model, data, moment)

    def state_vector(self) -> np.ndarray:
        """Position and velocity, `[nq + nv] f64`."""
        qpos, qvel = self._position_and_velocity()
        return np.concatenate([qpos, qvel])

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Continue from a position, `[nq]` in m and rad, and a velocity, `[nv]` in m/s and rad/s."""
        assert np.shape(qpos) == (self.model.nq,) and np.shape(qvel) == (self.model.nv,)
        self._write_state(np.array(qpos, np.float64), np.array(qvel, np.float64))

    def get_body_com(self, body_name: str) -> np.ndarray:
        """Position of a body's frame in the last forward pass, `[3] f64` with float32 values, m."""
        return np.array(np.float32(self.data.body(body_name).xpos), np.float64)

    @property
    def mujoco_renderer(self) -> MujocoRenderer:
        """Gymnasium's renderer, which shows the present state."""
        self._show_state()
        return self._gymnasium_env.mujoco_renderer

    def render(self) -> np.ndarray | tuple[np.ndarray, np.ndarray] | None:
        """A frame in the environment's `render_mode`, as Gymnasium gives it: `[height, width, 3] u8` for `rgb_array`.

        It shows the positions after the step. Gymnasium's shows those of the last forward pass, a physics step earlier
        at most.
        """
        if self.render_mode in RENDER_MODES and self.render_mode != "human":
            from mjx_walk.viewing.rendering import choose_opengl

            choose_opengl()
        renderer = self.mujoco_renderer
        if renderer.viewer is not None:
            renderer.viewer.make_context_current()  # Gymnasium leaves the context of another environment current
        return renderer.render(self.render_mode)

    def _close_gymnasium_env(self) -> None:
        """Free the OpenGL objects and close the window.

        Gymnasium leaves the objects to the garbage collector, which deletes those of another context instead.
        """
        viewer = self._gymnasium_env.mujoco_renderer.viewer
        if isinstance(viewer, OffScreenViewer):
            viewer.make_context_current()
            viewer.con.free()
        self._gymnasium_env.close()

    def _show_state(self) -> None:
        state = self._read_state()
        if state is not None and state.physics.act is not None:
            self._gymnasium_env.data.act[:] = state.physics.act
        self._gymnasium_env.set_state(*self._position_and_velocity())

    def _position_and_velocity(self) -> tuple[np.ndarray, np.ndarray]:
        state = self._read_state()
        if state is None:
            return self.init_qpos, self.init_qvel
        return np.array(state.physics.qpos, np.float64), np.array(state.physics.qvel, np.float64)
