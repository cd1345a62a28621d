"""Gait sheets, which show an episode on one page, and strips of its frames."""

from pathlib import Path

import matplotlib.figure
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import SubplotSpec

from mjx_walk.envs.motors import joint_of
from mjx_walk.utils.text import format_score
from mjx_walk.viewing.episode import Episode
from mjx_walk.viewing.figures import save_figure, standard_style

__all__ = ["draw_gait_sheet", "frame_strip"]

_NUM_FRAMES = 8
_STRIP_SECONDS = 1.0
_DETAIL_SECONDS = 3.0
"""Time shown of contacts, torques and reward terms, which repeat many times in an episode."""
_NO_HEIGHT = 1e-6
"""Range of heights below which a body moves in a horizontal plane, m. Then its y is drawn instead."""


@standard_style()
def draw_gait_sheet(episode: Episode, path: Path) -> Path:
    """Draw a gait sheet: height and speed of the view's body over the complete episode, and details from its middle.

    The details are frames over a second, and floor contacts, motors and reward terms over three seconds.
    """
    figure = matplotlib.figure.Figure(figsize=(12, 15), layout="constrained")
    grid = figure.add_gridspec(6, 1, height_ratios=[1.3, 1, 1, 0.8, 1.4, 1])
    num_detail_steps = round(_DETAIL_SECONDS / episode.seconds_per_step)
    start = max(0, (len(episode.rewards) - 1 - num_detail_steps) // 2)
    shown = slice(start, start + num_detail_steps)
    length = f"{len(episode.rewards)} steps ({episode.seconds[-1]:.1f} s)"
    figure.suptitle(f"{episode.env}: return {format_score(episode.rewards.sum())} in {length}")
    _frames(figure.add_subplot(grid[0]), episode, float(episode.seconds[start]))
    height = figure.add_subplot(grid[1])
    moves_in_plane = np.ptp(episode.body[:, 2]) < _NO_HEIGHT
    height.plot(episode.seconds, episode.body[:, 1 if moves_in_plane else 2])
    height.set_ylabel(f"{episode.body_name} {'y' if moves_in_plane else 'height'} (m)")
    speed = figure.add_subplot(grid[2], sharex=height)
    speed.plot(episode.seconds[1:], np.diff(episode.body[:, 0]) / episode.seconds_per_step)
    speed.set_ylabel(f"{episode.body_name} speed along x (m/s)")
    speed.set_xlabel("seconds")
    _contacts(figure.add_subplot(grid[3]), episode, shown)
    _motors(grid[4], episode, shown)
    terms = figure.add_subplot(grid[5])
    _lines(terms, episode, shown, episode.reward_terms)
    terms.set_ylabel("reward term per step")
    for axes in figure.axes[1:]:
        axes.grid(alpha=0.3)
    return save_figure(figure, path, dpi=100)


def frame_strip(episode: Episode, start: float, seconds: float) -> np.ndarray:
    """Eight frames side by side, evenly spaced over a part of a rendered episode.

    Args:
        episode: with frames. Past its end the last frame repeats.
        start: of the part, s.
        seconds: length of the part.

    Returns:
        `[height, 8·(width // 2), 3] u8`: the middle half of each frame.
    """
    times = np.linspace(start, start + seconds, _NUM_FRAMES) * episode.frames_per_second
    chosen = [episode.frames[min(int(time), len(episode.frames) - 1)] for time in times]
    width = chosen[0].shape[1] // 2
    return np.concatenate([frame[:, width // 2 : width // 2 + width] for frame in chosen], axis=1)


def _frames(axes: Axes, episode: Episode, start: float) -> None:
    """Show a strip of frames over one second."""
    axes.set_axis_off()
    if episode.frames:
        axes.imshow(frame_strip(episode, start, _STRIP_SECONDS))
        axes.set_title(f"{start:.1f} s to {start + _STRIP_SECONDS:.1f} s", fontsize=9)


def _contacts(axes: Axes, episode: Episode, shown: slice) -> None:
    """Draw a bar for each body while it touches the floor, for the six bodies that touch it most."""
    share = episode.floor_contacts.mean(axis=0)
    bodies = [int(body) for body in np.argsort(-share, kind="stable")[:6] if share[body] > 0.01]
    edges = episode.seconds[shown] - episode.seconds_per_step
    for line, body in enumerate(bodies):
        touching = episode.floor_contacts[shown, body]
        axes.broken_barh([(t, episode.seconds_per_step) for t in edges[touching]], (line - 0.4, 0.8))
    axes.set_yticks(range(len(bodies)), [_body_name(episode.model, body) for body in bodies])
    axes.set_xlim(edges[0], edges[-1])
    axes.set_title("floor contacts" if bodies else "no floor contacts", fontsize=9)


def _body_name(model: mujoco.MjModel, body: int) -> str:
    """A body's name, or of which body it is a part."""
    name = model.body(body).name
    return name or f"part of {_body_name(model, int(model.body_parentid[body])).removeprefix('part of ')}"


def _motors(place: SubplotSpec, episode: Episode, shown: slice) -> None:
    """Draw what the motors do, a plot per limb."""
    limbs: dict[str, dict[str, np.ndarray]] = {}
    for motor, forces in enumerate(episode.motor_forces.T):
        limb, name = _limb_and_name(episode.model, motor)
        limbs.setdefault(limb, {})[name] = forces
    plots = place.subgridspec(1, len(limbs)).subplots(sharey=True, squeeze=False)[0]
    for axes, (limb, forces) in zip(plots, limbs.items(), strict=True):
        axes.set_title(limb, fontsize=9)
        _lines(axes, episode, shown, forces)
    plots[0].set_ylabel("motor torque (N·m)\nor force (N)")


def _lines(axes: Axes, episode: Episode, shown: slice, series: dict[str, np.ndarray]) -> None:
    """Draw one labelled line per series."""
    for name, values in series.items():
        axes.plot(episode.seconds[shown], values[shown], label=name, linewidth=1)
    axes.legend(fontsize=7, ncols=2 if axes.get_title() else 8, loc="upper center", bbox_to_anchor=(0.5, -0.22))
    axes.set_xlabel("seconds", fontsize=8)


def _limb_and_name(model: mujoco.MjModel, motor: int) -> tuple[str, str]:
    """The limb that a motor drives and the motor's name, or without one that of the joint that only this motor drives.

    A limb is named after its first body. It begins where the tree of bodies branches.
    """
    name, joint = model.actuator(motor).name, joint_of(model, motor)
    if joint is None:
        return "other motors", name or f"motor {motor}"
    body = int(model.jnt_bodyid[joint])
    while (parent := int(model.body_parentid[body])) and (model.body_parentid == parent).sum() == 1:
        body = parent
    is_only = sum(joint_of(model, other) == joint for other in range(model.nu)) == 1
    return _body_name(model, body), name or (is_only and model.joint(joint).name) or f"motor {motor}"
