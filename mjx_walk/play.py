"""`python -m mjx_walk.play run=RUN_DIR`: watch a policy in the real Gymnasium."""

import dataclasses

import imageio.v3 as iio

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.cli import parsing
from mjx_walk.envs import require_model
from mjx_walk.settings.own_tasks import take_task
from mjx_walk.storage.files import replacing, user_path
from mjx_walk.storage.scores import BEST, POLICIES
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import MAX_SEED, setting
from mjx_walk.viewing.episode import record_episode
from mjx_walk.viewing.gait import draw_gait_sheet, frame_strip
from mjx_walk.viewing.page import require_library, write_page
from mjx_walk.viewing.rendering import write_film
from mjx_walk.viewing.viewer import show

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.play run=RUN_DIR|zoo:NAME [policy=NAME] [seed=0] [width=640] [height=480] [out=FILE.mp4]
                               [html=FILE.html] [gait=FILE.png] [strip=FILE.png start=5 seconds=1] [viewer=true]

  policy=best     the policy with the highest evaluation during training or at its end; policy=final is the newest one,
                  which eval scores by default. policy=medium and policy=simple are about two thirds and one third of
                  the way from the first evaluation to the best one, after a training with checkpoint.milestones=true.
  out=FILE.mp4    a film of one episode. It is written by default, as RUN_DIR/episode.mp4 or, for a policy of the zoo,
                  as NAME.mp4 in the current folder.
  html=FILE.html  a page that plays the episode in 3D with its reward terms, in any browser, offline (pip install
                  meshcat)
  gait=FILE.png   a gait sheet: frames, height and speed of a body, floor contacts, motors, reward terms
  strip=FILE.png  eight frames side by side, over `seconds` from `start`, both in seconds
  env.task=FILE.py:CLASS   the task of the run, if it is your own and you have not named its file before
  viewer=true     MuJoCo's live viewer, which needs a screen; it plays episodes until it is closed, with seed, seed + 1
                  and so on
"""


_START, _SECONDS = 5.0, 1.0
"""Part of the episode that a strip shows, s."""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    policy: str = setting(BEST, choices=POLICIES)
    out: str | None = None
    html: str | None = None
    gait: str | None = None
    strip: str | None = None
    start: float | None = setting(None, at_least=0)
    seconds: float | None = setting(None, above=0)
    viewer: bool = False
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)
    width: int = setting(640, at_least=64, at_most=4096)
    height: int = setting(480, at_least=64, at_most=4096)


def main(command_line: list[str]) -> None:
    """Play an episode, and write the files that the arguments name."""
    arguments = parsing.parse(Arguments, take_task(command_line), USAGE)
    parsing.stay_on_cpu()
    folder = zoo.open_run(arguments.run)
    for key in ("start", "seconds"):
        if getattr(arguments, key) is not None and arguments.strip is None:
            raise UserError(f"{key}={getattr(arguments, key):g} needs strip=FILE.png, the image that it is for")
    if arguments.html:
        require_library()
    paths = (arguments.out, arguments.html, arguments.gait, arguments.strip)
    film, html, gait, strip = (user_path(path) if path else None for path in paths)
    if not (any(paths) or arguments.viewer):
        film = zoo.output_path(folder, "episode.mp4")
    parsing.check_suffix(film, ".mp4", ".mkv", ".mov", ".avi")
    parsing.check_suffix(html, ".html", ".htm")
    for image in (gait, strip):
        parsing.check_suffix(image, ".png", ".jpg")
    written = [path for path in (film, html, gait, strip) if path]
    for path in written:
        parsing.check_writable(path)
    run = load_run(folder.path, "c", arguments.policy)
    if written:
        size = None if written == [html] else (arguments.width, arguments.height)
        episode = record_episode(require_model(run.task), run.policy, arguments.seed, size)
        shown = _shown(arguments, float(episode.seconds[-1]))
        print(
            f"{run.policy_name.title()} policy (step {run.policy_metadata['env_steps']:,}), {episode.env}: "
            f"return {episode.rewards.sum():,.1f} in {len(episode.rewards)} steps"
        )
        if film:
            write_film(episode.frames, film, episode.frames_per_second)
        if html:
            write_page(episode, html)
        if gait:
            draw_gait_sheet(episode, gait)
        if strip:
            with replacing(strip) as new:
                iio.imwrite(new, frame_strip(episode, *shown))
        print(*written, sep="\n")
    if arguments.viewer:
        show(require_model(run.task), run.policy, arguments.seed)


def _shown(arguments: Arguments, length: float) -> tuple[float, float]:
    """Start and length of the strip, s. By default it begins earlier in an episode that is shorter than five seconds.

    Raises:
        UserError: the given start is past the end of the episode.
    """
    if arguments.start is not None and arguments.start >= length:
        raise UserError(
            f"start={arguments.start:g} is past the end of the episode, which lasts {length:.2f} s; give a smaller one"
        )
    seconds = _SECONDS if arguments.seconds is None else arguments.seconds
    start = min(_START, max(0.0, length - seconds)) if arguments.start is None else arguments.start
    return start, seconds


if __name__ == "__main__":
    parsing.main(main)
