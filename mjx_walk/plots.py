"""`python -m mjx_walk.plots run=RUN_DIR`: draw the learning curves of a run into its folder."""

import dataclasses

from mjx_walk import zoo
from mjx_walk.cli import parsing
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.run_plots import plot_run

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.plots run=RUN_DIR

  Draws the curves that a run draws when it ends. The run may still be training.
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None


def main(command_line: list[str]) -> None:
    """Draw the curves, and print the files written."""
    folder = zoo.open_run(parsing.parse(Arguments, command_line, USAGE).run)
    written = plot_run(folder)
    if not written:
        reason = "the zoo keeps no metrics" if zoo.holds(folder.path) else "it has not logged any metrics yet"
        raise UserError(f"{folder.path} cannot be drawn: {reason}; give a run that has trained")
    print(*written, sep="\n")


if __name__ == "__main__":
    parsing.main(main)
