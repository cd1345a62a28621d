"""Films of a policy during training, as MP4 files and in TensorBoard; a child process on the CPU makes them."""

import io
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import jax
import numpy as np

from mjx_walk.envs import require_model
from mjx_walk.evaluation.saved_policies import SavedPolicy
from mjx_walk.logs.tensorboard import EventFile, Summary
from mjx_walk.machine.subprocesses import start_module
from mjx_walk.settings.config import Config
from mjx_walk.settings.saved_config import save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import FINAL
from mjx_walk.utils.types import PolicyParams
from mjx_walk.viewing.episode import record_episode
from mjx_walk.viewing.rendering import write_film

__all__ = ["Filmer", "film"]

_LOGGER = logging.getLogger(__name__)
_SIZE = (320, 240)
_FRAMES_PER_SECOND = 25.0
_SECONDS_IN_TENSORBOARD = 5.0
_TENSORBOARD_FRAME_STRIDE = 2
"""TensorBoard's films are GIFs, which are large, so they keep one frame in this many."""


class Filmer:
    """Makes one film at a time; policies evaluated in the meantime are not filmed."""

    def __init__(self, config: Config, folder: RunFolder):
        """
        Args:
            config: of the run.
            folder: of the run; its `films/` holds the films.
        """
        self._config = config
        self._folder = folder
        self._process: subprocess.Popen | None = None

    def take(self, policy_params: PolicyParams, env_steps: int) -> None:
        """Start to film a policy, unless the previous film is still being made. Warn if this fails."""
        if self._process and self._process.poll() is None:
            return
        film = RunFolder(self._folder.path / "films" / str(env_steps))
        params = jax.device_get(policy_params)
        try:
            film.path.mkdir(parents=True, exist_ok=True)
            save_config(self._config, film.config)
            checkpoint.save(film.policy(FINAL), params, {"env_steps": env_steps}, as_numpy=True)
            self._process = start_module("viewing.film", str(film.path), env={"JAX_PLATFORMS": "cpu"})
        except OSError as error:  # a film is no reason to end a training
            _LOGGER.warning(f"cannot film step {env_steps:,} of {self._folder.path}: {error}")

    def wait(self) -> None:
        """Wait until the last film is finished."""
        if self._process:
            self._process.wait()


def film(folder: Path) -> None:
    """Film the policy saved in `films/ENV_STEPS`, and replace the folder with `films/ENV_STEPS.mp4`."""
    run = SavedPolicy(RunFolder(folder), "c", FINAL)
    episode = record_episode(require_model(run.task), run.policy, size=_SIZE, frame_rate=_FRAMES_PER_SECOND)
    write_film(episode.frames, folder.with_suffix(".mp4"), episode.frames_per_second)
    num_shown = round(_SECONDS_IN_TENSORBOARD * episode.frames_per_second)
    shown = np.stack(episode.frames[:num_shown:_TENSORBOARD_FRAME_STRIDE])
    frames_per_second = episode.frames_per_second / _TENSORBOARD_FRAME_STRIDE
    _add_to_tensorboard(folder.parent.parent, int(folder.name), shown, frames_per_second)
    shutil.rmtree(folder)


def _add_to_tensorboard(run_dir: Path, env_steps: int, frames: np.ndarray, frames_per_second: float) -> None:
    """Add a GIF of frames, `[N, height, width, 3] u8`, to the run's events.

    `add_video` would need MoviePy to write the same GIF.
    """
    gif = io.BytesIO()
    iio.imwrite(gif, frames, extension=".gif", duration=1000.0 / frames_per_second, loop=0)
    _, height, width, _ = frames.shape
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif.getvalue())
    events = EventFile(run_dir)
    events.add({"film": image}, env_steps)
    events.close()


if __name__ == "__main__":
    os.nice(10)
    film(Path(sys.argv[1]))
