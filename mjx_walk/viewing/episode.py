"""One episode of a policy in the real Gymnasium, kept to be looked at."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import mujoco
import numpy as np

from mjx_walk.envs import Task
from mjx_walk.viewing.rendering import choose_opengl

_CAMERA = {
    "type": mujoco.mjtCamera.mjCAMERA_TRACKING,
    "trackbodyid": 1,
    "distance": 4.0,
    "azimuth": 90.0,
    "elevation": -8.0,
}
"""From the side, following the torso. Gymnasium's own default stands still in version 1.4, and films an empty floor."""


@dataclasses.dataclass
class Episode:
    """T steps; quantities after each, in MuJoCo's units (m, rad, s, N·m)."""

    env: str
    model: mujoco.MjModel
    seconds_per_step: float
    qpos: np.ndarray
    """`[T, nq]`."""
    torso: np.ndarray
    """`[T, 3]`, the position of the first body."""
    torques: np.ndarray
    """`[T, nu]`, what the motors exert."""
    floor_contacts: np.ndarray
    """`[T, nbody] bool`: the body touches the floor."""
    rewards: np.ndarray
    """`[T]`."""
    reward_terms: dict[str, np.ndarray]
    """`[T]` each, as Gymnasium's `info` has them."""
    frames: list[np.ndarray]
    """`[height, width, 3] u8`, one for every `steps_per_frame`; empty if nothing was rendered."""
    steps_per_frame: int

    @property
    def seconds(self) -> np.ndarray:
        """`[T]`, since the start."""
        return self.seconds_per_step * np.arange(1, len(self.rewards) + 1)

    @property
    def frames_per_second(self) -> float:
        """At which the film runs in real time."""
        return 1.0 / (self.seconds_per_step * self.steps_per_frame)


def record_episode(
    task: Task,
    policy: Callable[[np.ndarray], np.ndarray],
    seed: int = 0,
    size: tuple[int, int] | None = None,
    frame_rate: float = 30.0,
) -> Episode:
    """Play one episode in `gymnasium.make`.

    Args:
        task: says which environment, with which keywords.
        policy: `[observation_size] → [action_size]`, both in Gymnasium's units.
        seed: of the reset.
        size: width and height to render in, from the side; without, nothing is rendered.
        frame_rate: about how many frames a second of the episode.

    Raises:
        UserError: it is to be rendered, and nothing here can.
    """
    rendering: dict[str, Any] = {}
    if size:
        choose_opengl()
        rendering = {"render_mode": "rgb_array", "width": size[0], "height": size[1]}
    env = make_gymnasium(task, **rendering)
    inner: Any = env.unwrapped
    model, data = inner.model, inner.data
    if size:
        inner.mujoco_renderer.default_cam_config = _CAMERA
        inner.mujoco_renderer.camera_id = None  # which would stop it from following
        _draw_larger_floor(model)
        model.vis.quality.shadowsize = 1024  # of 4096, which costs a CPU a quarter of the time
    steps_per_frame = max(1, round(1.0 / (inner.dt * frame_rate)))
    kept: dict[str, list[Any]] = {name: [] for name in ("qpos", "torso", "torques", "floor_contacts", "rewards")}
    terms: list[dict[str, float]] = []
    frames = []
    obs, _ = env.reset(seed=seed)
    is_over = False
    while not is_over:
        obs, reward, terminated, truncated, info = env.step(policy(obs))
        is_over = terminated or truncated
        kept["qpos"].append(data.qpos.copy())
        kept["torso"].append(data.xpos[1].copy())
        kept["torques"].append((data.actuator_force * model.actuator_gear[:, 0]).copy())
        kept["floor_contacts"].append(_floor_contacts(model, data))
        kept["rewards"].append(float(reward))
        terms.append({name: float(value) for name, value in info.items() if name.startswith("reward_")})
        if size and len(terms) % steps_per_frame == 1 % steps_per_frame:
            frames.append(np.asarray(env.render()))
    env.close()
    return Episode(
        env=task.gymnasium_id,
        model=model,
        seconds_per_step=inner.dt,
        reward_terms={name: np.array([step[name] for step in terms]) for name in terms[0]},
        frames=frames,
        steps_per_frame=steps_per_frame,
        **{name: np.array(values) for name, values in kept.items()},
    )


def make_gymnasium(task: Task, **keywords: Any) -> gymnasium.Env:
    """The real environment that a task stands for, with further keywords of Gymnasium's."""
    options = task.gymnasium_kwargs() | {"max_episode_steps": task.options.max_episode_steps}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # v4 is asked for knowingly
        return gymnasium.make(task.gymnasium_id, **options, **keywords)


def _draw_larger_floor(model: mujoco.MjModel, factor: float = 20.0) -> None:
    """A plane is endless to touch, but drawn as large as it says; who runs fast has left it behind after 3 seconds."""
    is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_size[is_plane, :2] *= factor
    model.mat_texrepeat[model.geom_matid[is_plane]] *= factor


def _floor_contacts(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Which bodies touch a plane, `[nbody] bool`."""
    touches = np.zeros(model.nbody, bool)
    pairs = data.contact.geom[data.contact.dist <= 0.0]
    is_plane = model.geom_type[pairs] == mujoco.mjtGeom.mjGEOM_PLANE
    for plane in (0, 1):
        touches[model.geom_bodyid[pairs[is_plane[:, plane], 1 - plane]]] = True
    return touches
