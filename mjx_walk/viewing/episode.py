"""One episode of a policy, in the real Gymnasium if it has the task, recorded for drawing."""

import dataclasses
import warnings
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import gymnasium
import mujoco
import numpy as np

from mjx_walk.envs import Task, View
from mjx_walk.envs.models import warn_of_changed_sources
from mjx_walk.envs.motors import torques_per_force
from mjx_walk.machine.quiet_mujoco import hide_deprecations
from mjx_walk.viewing.rendering import choose_opengl
from mjx_walk.viewing.task_env import TaskEnv

__all__ = ["Episode", "camera_settings", "make_gymnasium", "record_episode"]

_FLOOR_SCALE = 20.0
"""MuJoCo draws a plane only as large as its `size`; a fast runner leaves it after 3 seconds."""


@dataclasses.dataclass
class Episode:
    """T recorded steps; each quantity is the one after its step, in MuJoCo's units (m, rad, s, N·m)."""

    env: str
    """Gymnasium's name of the environment."""
    is_in_gymnasium: bool
    """Whether the real Gymnasium played it, not the task's own engine."""
    model: mujoco.MjModel
    seconds_per_step: float
    qpos: np.ndarray
    """`[T, nq]`."""
    view: View
    """The task's view."""
    body: np.ndarray
    """`[T, 3]`, position of the body that the view names."""
    motor_forces: np.ndarray
    """`[T, nu]`, torque or, on a slider or a tendon, force of each motor."""
    floor_contacts: np.ndarray
    """`[T, nbody] bool`: the body touches the floor."""
    rewards: np.ndarray
    """`[T]`."""
    reward_terms: dict[str, np.ndarray]
    """`[T]` each, under the names of Gymnasium's `info`."""
    frames: list[np.ndarray]
    """`[height, width, 3] u8` each, one every `steps_per_frame` steps; empty if nothing was rendered."""
    steps_per_frame: int

    @property
    def body_name(self) -> str:
        """Name of the body that the view names."""
        return self.model.body(self.view.body).name

    @property
    def seconds(self) -> np.ndarray:
        """Time since the start, `[T]`."""
        return self.seconds_per_step * np.arange(1, len(self.rewards) + 1)

    @property
    def frames_per_second(self) -> float:
        """Frame rate of a film in real time."""
        return 1.0 / (self.seconds_per_step * self.steps_per_frame)


def record_episode(
    task: Task,
    policy: Callable[[np.ndarray], np.ndarray],
    seed: int = 0,
    size: tuple[int, int] | None = None,
    frame_rate: float = 30.0,
) -> Episode:
    """Play one episode in the real Gymnasium, or in the task's own engine if Gymnasium has no equal or no hills.

    Args:
        task: the environment and its keywords.
        policy: `[observation_size] → [action_size]`, both in Gymnasium's units.
        seed: of the reset.
        size: width and height of the frames; None renders nothing.
        frame_rate: frames per second of simulated time, rounded to a divisor of the step rate.

    Raises:
        UserError: frames are wanted, and this machine cannot render.
    """
    env = make_gymnasium(task) if size is None else _make_rendered(task, *size)
    inner: Any = env.unwrapped
    model, data = inner.model, inner.data
    torques = torques_per_force(model)
    steps_per_frame = max(1, round(1.0 / (inner.dt * frame_rate)))
    kept: defaultdict[str, list[Any]] = defaultdict(list)
    terms: defaultdict[str, list[float]] = defaultdict(list)
    frames = []
    obs, _ = env.reset(seed=seed)
    is_over = False
    while not is_over:
        obs, reward, terminated, truncated, info = env.step(policy(obs))
        is_over = terminated or truncated
        kept["qpos"].append(data.qpos.copy())
        kept["body"].append(data.xpos[task.view.body].copy())
        kept["motor_forces"].append(data.actuator_force * torques)
        kept["floor_contacts"].append(_floor_contacts(model, data))
        kept["rewards"].append(float(reward))
        for name in task.gymnasium_reward_terms:
            if name in info:  # v4 leaves out some
                terms[name].append(float(info[name]))
        if size and len(kept["rewards"]) % steps_per_frame == 1 % steps_per_frame:
            frames.append(np.asarray(env.render()))
    env.close()
    return Episode(
        env=task.gymnasium_id,
        is_in_gymnasium=not isinstance(inner, TaskEnv),
        model=model,
        seconds_per_step=inner.dt,
        view=task.view,
        reward_terms={name: np.array(values) for name, values in terms.items()},
        frames=frames,
        steps_per_frame=steps_per_frame,
        **{name: np.array(values) for name, values in kept.items()},
    )


def make_gymnasium(task: Task, **keywords: Any) -> gymnasium.Env:
    """Make the real Gymnasium environment of a task, with further keywords of `gymnasium.make`.

    A task without an equivalent in Gymnasium runs in its own engine, and so does one on hills.

    Raises:
        UserError: the model file is gone.
    """
    if not task.is_in_gymnasium or task.ground.is_on:
        return TaskEnv(task, **keywords)
    warn_of_changed_sources(task.model_file, task.model_sources)
    options: dict[str, Any] = task.gymnasium_kwargs() | {"max_episode_steps": task.options.max_episode_steps}
    with hide_deprecations(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the user chose v4
        return gymnasium.make(task.gymnasium_id, **options, **keywords)


def camera_settings(view: View) -> dict[str, object]:
    """Fields of MuJoCo's camera for a view. Gymnasium 1.4's own default stands still and films an empty floor."""
    settings: dict[str, Any] = {
        "distance": view.distance,
        "azimuth": view.azimuth,
        "elevation": view.elevation,
    }
    if view.center is None:
        return settings | {"type": mujoco.mjtCamera.mjCAMERA_TRACKING, "trackbodyid": view.body}
    return settings | {"type": mujoco.mjtCamera.mjCAMERA_FREE, "lookat": np.array(view.center)}


def _make_rendered(task: Task, width: int, height: int) -> gymnasium.Env:
    """Make the environment so that `render()` gives frames of the task's view."""
    choose_opengl()
    env = make_gymnasium(task, render_mode="rgb_array", width=width, height=height)
    inner: Any = env.unwrapped
    model = inner.model
    inner.mujoco_renderer.default_cam_config = camera_settings(task.view)
    inner.mujoco_renderer.camera_id = None  # a camera id would stop the camera from following
    is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_size[is_plane, :2] *= _FLOOR_SCALE
    model.mat_texrepeat[model.geom_matid[is_plane & (model.geom_matid >= 0)]] *= _FLOOR_SCALE
    model.vis.quality.shadowsize = 1024  # MuJoCo's 4096 takes a quarter of the rendering time on a CPU
    return env


def _floor_contacts(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Whether each body touches a geom of the world, such as the floor, `[nbody] bool`."""
    touches = np.zeros(model.nbody, bool)
    pairs = data.contact.geom[data.contact.dist <= 0.0]
    is_world = model.geom_bodyid[pairs] == 0
    touches[model.geom_bodyid[pairs[is_world[:, ::-1]]]] = True
    return touches
