"""A gait sheet: what a body does over an episode, on one page; and a strip of frames."""

from pathlib import Path

import matplotlib.figure
import mujoco
import numpy as np

from mjx_walk.viewing.episode import Episode

_NUM_FRAMES = 8
_SECONDS_OF_FRAMES = 1.0
_SECONDS_SHOWN = 3.0
"""Of contacts and torques, which repeat many times in an episode."""


def draw_gait_sheet(episode: Episode, path: Path) -> Path:
    """Draw torso height and speed over the whole episode, and more of its middle: frames over a second, and floor
    contacts, torques and reward terms over three.
    """
    figure = matplotlib.figure.Figure(figsize=(12, 13), layout="constrained")
    grid = figure.add_gridspec(5, 2, height_ratios=[1.3, 1, 1, 1.2, 1.2])
    last = len(episode.rewards) - 1
    start = max(0, (last - round(_SECONDS_SHOWN / episode.seconds_per_step)) // 2)
    shown = slice(start, start + round(_SECONDS_SHOWN / episode.seconds_per_step))
    length = f"{len(episode.rewards)} steps ({episode.seconds[-1]:.1f} s)"
    figure.suptitle(f"{episode.env}: return {episode.rewards.sum():,.0f} in {length}")
    _frames(figure.add_subplot(grid[0, :]), episode, float(episode.seconds[shown.start]))
    height = figure.add_subplot(grid[1, :])
    height.plot(episode.seconds, episode.torso[:, 2])
    height.set_ylabel("torso height (m)")
    speed = figure.add_subplot(grid[2, :], sharex=height)
    speed.plot(episode.seconds[1:], np.diff(episode.torso[:, 0]) / episode.seconds_per_step)
    speed.set_ylabel("torso speed forward (m/s)")
    speed.set_xlabel("seconds")
    _contacts(figure.add_subplot(grid[3, :]), episode, shown)
    _lines(figure.add_subplot(grid[4, 0]), episode, shown, dict(zip(_motors(episode), episode.torques.T, strict=True)))
    _lines(figure.add_subplot(grid[4, 1]), episode, shown, episode.reward_terms)
    for axes, label in zip(figure.axes[-2:], ("torque (N·m)", "reward term, a step"), strict=True):
        axes.set_ylabel(label)
    for axes in figure.axes[1:]:
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=100)
    return path


def frame_strip(episode: Episode, start: float, seconds: float) -> np.ndarray:
    """Frames side by side, evenly spaced over a part of a rendered episode, which is cut off at its end.

    Args:
        episode: with frames.
        start: of the part, s.
        seconds: that it lasts.

    Returns:
        `[height, 8·(width // 3), 3] u8`: the middle third of each.
    """
    times = np.linspace(start, start + seconds, _NUM_FRAMES) * episode.frames_per_second
    chosen = [episode.frames[min(int(time), len(episode.frames) - 1)] for time in times]
    width = chosen[0].shape[1] // 3
    return np.concatenate([frame[:, width : 2 * width] for frame in chosen], axis=1)


def _frames(axes, episode: Episode, start: float) -> None:
    """A strip of them over a second."""
    axes.set_axis_off()
    if episode.frames:
        axes.imshow(frame_strip(episode, start, _SECONDS_OF_FRAMES))
        axes.set_title(f"{start:.1f} s to {start + _SECONDS_OF_FRAMES:.1f} s", fontsize=9)


def _contacts(axes, episode: Episode, shown: slice) -> None:
    """A bar for each body that touches the floor, while it does."""
    share = episode.floor_contacts.mean(axis=0)
    bodies = [body for body in np.argsort(-share, kind="stable")[:6] if share[body] > 0.01]
    edges = episode.seconds[shown] - episode.seconds_per_step
    for line, body in enumerate(bodies):
        touching = episode.floor_contacts[shown, body]
        axes.broken_barh([(t, episode.seconds_per_step) for t in edges[touching]], (line - 0.4, 0.8))
    names = [mujoco.mj_id2name(episode.model, mujoco.mjtObj.mjOBJ_BODY, int(body)) for body in bodies]
    axes.set_yticks(range(len(bodies)), names)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_title("touches the floor", fontsize=9)


def _lines(axes, episode: Episode, shown: slice, series: dict[str, np.ndarray]) -> None:
    for name, values in series.items():
        axes.plot(episode.seconds[shown], values[shown], label=name, linewidth=1)
    axes.legend(fontsize=6, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    axes.set_xlabel("seconds")


def _motors(episode: Episode) -> list[str]:
    model = episode.model
    return [
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)
        or mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, int(model.actuator_trnid[i, 0]))
        for i in range(model.nu)
    ]
