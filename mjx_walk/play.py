"""`python -m mjx_walk.play run=RUN_DIR`: see a policy move, in the real Gymnasium."""

import dataclasses
from pathlib import Path

import imageio.v3 as iio

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting
from mjx_walk.viewing.episode import record_episode
from mjx_walk.viewing.gait import draw_gait_sheet, frame_strip
from mjx_walk.viewing.page import require_library, write_page
from mjx_walk.viewing.rendering import write_film
from mjx_walk.viewing.viewer import show

USAGE = """
usage: python -m mjx_walk.play run=RUN_DIR|zoo:NAME [seed=0] [width=640] [height=480] [out=FILE.mp4] [html=FILE.html]
                               [gait=FILE.png] [strip=FILE.png start=5 seconds=1] [viewer=true]

  out=FILE.mp4    a film of one episode; written unless something else is asked for, by default RUN_DIR/episode.mp4, or
                  NAME.mp4 here for a policy of the zoo
  html=FILE.html  a page that plays it in 3D in any browser, offline, beside its reward terms (pip install meshcat)
  gait=FILE.png   a gait sheet: frames, torso height and speed, floor contacts, torques, reward terms
  strip=FILE.png  eight frames side by side, over so many seconds from a start on
  viewer=true     MuJoCo's live viewer, which needs a screen; episodes follow each other until it is closed
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    out: str | None = None
    html: str | None = None
    gait: str | None = None
    strip: str | None = None
    start: float = setting(5.0, at_least=0)
    seconds: float = setting(1.0, above=0)
    viewer: bool = False
    seed: int = setting(0, at_least=0)
    width: int = setting(640, at_least=64, at_most=4096)
    height: int = setting(480, at_least=64, at_most=4096)


def main(arguments: list[str]) -> None:
    """Play, and write what was asked for."""
    parsed = cli.parse(Arguments, arguments, USAGE)
    cli.stay_on_cpu()
    if parsed.run is None:
        raise UserError(f"say which run: run=RUN_DIR, or one of run={zoo.PREFIX}{f', {zoo.PREFIX}'.join(zoo.names())}")
    folder = zoo.open_run(parsed.run)
    if parsed.html:
        require_library()
    film, html, gait, strip = (Path(p) if p else None for p in (parsed.out, parsed.html, parsed.gait, parsed.strip))
    if not (film or html or gait or strip or parsed.viewer):
        film = zoo.output_path(folder, "episode.mp4")
    cli.check_suffix(film, ".mp4", ".mkv", ".mov", ".avi")
    for image in (gait, strip):
        cli.check_suffix(image, ".png", ".jpg")
    asked = [path for path in (film, html, gait, strip) if path]
    for path in asked:
        cli.check_writable(path)
    run = load_run(folder.path, "c")
    if asked:
        size = None if asked == [html] else (parsed.width, parsed.height)
        episode = record_episode(run.task, run.policy, parsed.seed, size)
        print(f"{episode.env}: return {episode.rewards.sum():,.1f} in {len(episode.rewards)} steps")
        if film:
            write_film(episode.frames, film, episode.frames_per_second)
            print(film)
        if html:
            print(write_page(episode, html))
        if gait:
            print(draw_gait_sheet(episode, gait))
        if strip:
            iio.imwrite(strip, frame_strip(episode, parsed.start, parsed.seconds))
            print(strip)
    if parsed.viewer:
        show(run.task, run.policy, parsed.seed)


if __name__ == "__main__":
    cli.main(main)
