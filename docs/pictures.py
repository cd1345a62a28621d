"""`python docs/pictures.py`: draw the picture of each task's page, a frame of the shipped csac policy.

It needs a renderer, so the build of the site does not run it.
"""

from pathlib import Path

import imageio.v3 as iio

import mjx_walk
from mjx_walk.cli.parsing import stay_on_cpu
from mjx_walk.envs import GYMNASIUM_TASKS
from mjx_walk.viewing.episode import record_episode

TASKS = Path(__file__).parent / "tasks"
SIZE = 480, 320
SECONDS_TO_FRAME = 0.5
NUM_FRAMES = 4
"""The last of these is the picture; shorter episodes give their last one."""


def draw(name: str) -> None:
    """Draw the picture of one task."""
    run = mjx_walk.load_run(f"zoo:{name}-csac", physics="c")
    episode = record_episode(run.task, run.policy, size=SIZE, frame_rate=1 / SECONDS_TO_FRAME)
    iio.imwrite(TASKS / f"{name}.webp", episode.frames[:NUM_FRAMES][-1], quality=80)


if __name__ == "__main__":
    stay_on_cpu()
    for name in GYMNASIUM_TASKS:
        draw(name)
