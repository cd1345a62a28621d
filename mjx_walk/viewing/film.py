"""Films of a policy while it trains, beside its curves in TensorBoard, made by a process of its own on the CPU."""

import io
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import jax
import numpy as np

from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import Config, save_config
from mjx_walk.runs.policies import SavedPolicy
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.runs.tensorboard import Summary, SummaryWriter
from mjx_walk.utils.subprocesses import start_module
from mjx_walk.viewing.episode import record_episode
from mjx_walk.viewing.rendering import write_film

_SIZE = (320, 240)
_FRAMES_PER_SECOND = 25.0
_SECONDS_IN_TENSORBOARD = 5.0
_EVERY_NTH_FRAME = 2
"""Is kept in TensorBoard, whose films are GIFs, and large."""


class Filmer:
    """Takes one film at a time; what is evaluated meanwhile is not filmed."""

    def __init__(self, config: Config, folder: RunFolder):
        """
        Args:
            config: of the run.
            folder: of the run; films are put into its `films/`.
        """
        self._config = config
        self._folder = folder
        self._process: subprocess.Popen | None = None

    def take(self, policy_params: Any, env_steps: int) -> None:
        """Begin a film of a policy, unless the last one is not finished."""
        if self._process and self._process.poll() is None:
            return
        film = RunFolder(self._folder.path / "films" / str(env_steps))
        film.path.mkdir(parents=True, exist_ok=True)
        save_config(self._config, film.config)
        params = jax.device_get(policy_params)
        checkpoint.save(film.best_policy, params, {"env_steps": env_steps}, as_numpy=True)
        self._process = start_module("viewing.film", str(film.path), env={"JAX_PLATFORMS": "cpu"})

    def wait(self) -> None:
        """Until the last film is finished."""
        if self._process:
            self._process.wait()


def film(folder: Path) -> Path:
    """Film the policy that lies in a folder of `films/`, which is named after its environment steps, and remove it."""
    run = SavedPolicy(RunFolder(folder), "c")
    episode = record_episode(run.task, run.policy, size=_SIZE, frame_rate=_FRAMES_PER_SECOND)
    path = folder.with_suffix(".mp4")
    write_film(episode.frames, path, episode.frames_per_second)
    shown = episode.frames[: round(_SECONDS_IN_TENSORBOARD * episode.frames_per_second) : _EVERY_NTH_FRAME]
    _show_in_tensorboard(folder.parent.parent, int(folder.name), shown, episode.frames_per_second / _EVERY_NTH_FRAME)
    shutil.rmtree(folder)
    return path


def _show_in_tensorboard(run_dir: Path, env_steps: int, frames: list[np.ndarray], frames_per_second: float) -> None:
    """Not by `add_video`, which would need MoviePy to write the same GIF."""
    gif = io.BytesIO()
    iio.imwrite(gif, np.stack(frames), extension=".gif", duration=1000.0 / frames_per_second, loop=0)
    height, width = frames[0].shape[:2]
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif.getvalue())
    with SummaryWriter(str(run_dir), filename_suffix=f".film{env_steps}") as events:
        events.file_writer.add_summary(Summary(value=[Summary.Value(tag="film", image=image)]), env_steps)


if __name__ == "__main__":
    os.nice(10)
    film(Path(sys.argv[1]))
