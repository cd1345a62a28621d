"""What code for Gymnasium's MuJoCo environments reads of them: the model, times, state and frames.

Each environment holds the real one, its twin. The twin draws resets and renders, and is never stepped.
"""

import os
import sys
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer, OffScreenViewer
from gymnasium.envs.registration import load_env_creator

from mjx_walk.envs import TASKS, State, TaskOptions
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.quiet_mujoco import hide_deprecations

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

_PHYSICS = ("body", "jnt", "dof", "geom", "site", "actuator", "tendon", "eq", "pair")
_APPEARANCE = ("rgba", "matid", "group", "user")
"""Prefixes of the model's arrays that its motion depends on, and suffixes of those that only frames show."""

RENDER_MODES = ("human", "rgb_array", "depth_array", "rgbd_tuple")


def split_keywords(keywords: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Keywords of the task, and those of `RENDER_KEYWORDS`."""
    rendering = {name: value for name, value in keywords.items() if name in RENDER_KEYWORDS}
    return {name: value for name, value in keywords.items() if name not in rendering}, rendering


def make_twin(options: TaskOptions, rendering: dict[str, Any]) -> MujocoEnv:
    """Gymnasium's own environment, without wrappers.

    Args:
        options: env options.
        rendering: values of `RENDER_KEYWORDS`.

    Raises:
        UserError: `render_mode="human"` without a screen, with which Gymnasium ends the process.
    """
    has_screen = sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
    if rendering.get("render_mode") == "human" and not has_screen:
        raise UserError("render_mode='human' needs a screen; use render_mode='rgb_array'")
    spec = gymnasium.spec(TASKS[options.name][0].id_of(options))
    create: Any = load_env_creator(str(spec.entry_point))
    with hide_deprecations():
        return create(**spec.kwargs | options.gymnasium_kwargs() | rendering)


def physics_values(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Copies of the model's values that its motion depends on, by name."""
    names = [name for name in dir(model) if name.partition("_")[0] in _PHYSICS and not name.endswith(_APPEARANCE)]
    values = {name: np.array(getattr(model, name)) for name in names if "_" in name}
    options = [name for name in dir(model.opt) if not name.startswith("_")]
    return values | {f"opt.{name}": np.array(getattr(model.opt, name)) for name in options}


def refuse_changes(model: mujoco.MjModel, original: dict[str, np.ndarray]) -> None:
    """Check that the model has the values that the physics was compiled with.

    Raises:
        UserError: it has others.
    """
    for name, value in physics_values(model).items():
        if not np.array_equal(value, original[name]):
            raise UserError(f"the physics ignores your change to model.{name}; use xml_file=PATH instead")


class MujocoAttributes:
    """The attributes of Gymnasium's `MujocoEnv`, except for a live `data`.

    The physics reads nothing that is written to them, except for the state of `set_state`. In a single environment,
    resets read `init_qpos` and `init_qvel`.
    """

    _twin: MujocoEnv
    render_mode: str | None

    def _read_state(self) -> State | None:
        """State of this environment; None before the first reset."""
        raise NotImplementedError

    def _write_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        raise NotImplementedError

    @property
    def model(self) -> mujoco.MjModel:
        """A copy of the MuJoCo model, from which frames are rendered. Resets refuse changes of its physics."""
        return self._twin.model

    @property
    def dt(self) -> float:
        """Duration of a step, s."""
        return self._twin.dt

    @property
    def frame_skip(self) -> int:
        return self._twin.frame_skip

    @property
    def init_qpos(self) -> np.ndarray:
        """`[nq] f64`, m and rad: the pose to which resets add noise."""
        return self._twin.init_qpos

    @property
    def init_qvel(self) -> np.ndarray:
        """`[nv] f64`, m/s and rad/s."""
        return self._twin.init_qvel

    @property
    def observation_structure(self) -> dict[str, int]:
        """Sizes of the observation's parts, of the tasks for which Gymnasium defines them."""
        return self._twin.observation_structure  # type: ignore[attr-defined]

    @property
    def width(self) -> int:
        return self._twin.width

    @property
    def height(self) -> int:
        return self._twin.height

    @property
    def camera_id(self) -> int | None:
        return self._twin.camera_id

    @property
    def camera_name(self) -> str | None:
        return self._twin.camera_name

    def state_vector(self) -> np.ndarray:
        """Position and velocity, `[nq + nv] f64`."""
        qpos, qvel = self._position_and_velocity()
        return np.concatenate([qpos, qvel])

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Continue from a position, `[nq]` in m and rad, and a velocity, `[nv]` in m/s and rad/s."""
        assert np.shape(qpos) == (self.model.nq,) and np.shape(qvel) == (self.model.nv,)
        self._write_state(np.asarray(qpos, np.float32), np.asarray(qvel, np.float32))

    def get_body_com(self, body_name: str) -> np.ndarray:
        """Position of a body's frame, `[3] f64`, m."""
        self._show_in_twin()
        return self._twin.get_body_com(body_name).copy()

    @property
    def mujoco_renderer(self) -> MujocoRenderer:
        """Gymnasium's renderer, which shows the present state."""
        self._show_in_twin()
        return self._twin.mujoco_renderer

    def render(self) -> Any:
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

    def _close_twin(self) -> None:
        """Free the OpenGL objects and close the window.

        Gymnasium leaves the objects to the garbage collector, which deletes those of another context instead.
        """
        viewer = self._twin.mujoco_renderer.viewer
        if isinstance(viewer, OffScreenViewer):
            viewer.make_context_current()
            viewer.con.free()
        self._twin.close()

    def _show_in_twin(self) -> None:
        self._twin.set_state(*self._position_and_velocity())

    def _position_and_velocity(self) -> tuple[np.ndarray, np.ndarray]:
        state = self._read_state()
        if state is None:
            return self.init_qpos, self.init_qvel
        return np.array(state.physics.qpos, np.float64), np.array(state.physics.qvel, np.float64)
