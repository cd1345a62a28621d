"""`python -m mjx_walk.plots run=RUN_DIR`: learning curves of a run, in its folder."""

import dataclasses

from mjx_walk import zoo
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.curves import plot_run

USAGE = """
usage: python -m mjx_walk.plots run=RUN_DIR

  Draws its curves again, which a run does at its end; it may still be training.
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None


def main(arguments: list[str]) -> None:
    """Draw, and say what was written."""
    parsed = cli.parse(Arguments, arguments, USAGE)
    folder = zoo.open_run(parsed.run)
    written = plot_run(folder)
    if not written:
        raise UserError(f"{folder.path} has no metrics to draw")
    print(*written, sep="\n")


if __name__ == "__main__":
    cli.main(main)
