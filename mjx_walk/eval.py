"""`python -m mjx_walk.eval run=RUN_DIR`: score the deterministic policy of a run."""

import dataclasses

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting

USAGE = """
usage: python -m mjx_walk.eval run=RUN_DIR|zoo:NAME [episodes=100] [backend=gymnasium|sim] [seed=0] [physics=ENGINE]

  backend=gymnasium   the real environment, on the CPU; writes eval_gymnasium.json into the run folder
  backend=sim         the run's own engine, or the one given by physics=
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    episodes: int = setting(100, at_least=1)
    backend: str = setting("gymnasium", choices=("gymnasium", "sim"))
    seed: int = setting(0, at_least=0)
    physics: str | None = None


def main(command_line: list[str]) -> None:
    """Score the policy, print the result, and save a Gymnasium score in the run folder."""
    arguments = cli.parse(Arguments, command_line, USAGE)
    if arguments.physics and arguments.backend == "gymnasium":
        raise UserError(f"physics={arguments.physics} needs backend=sim: Gymnasium has its own engine")
    folder = zoo.open_run(arguments.run)
    run = load_run(folder.path, arguments.physics)
    is_saved = arguments.backend == "gymnasium" and not zoo.holds(folder.path)
    if is_saved:
        cli.check_writable(folder.gymnasium_scores)
    scores = run.evaluate(arguments.episodes, arguments.backend, arguments.seed)
    print(scores)
    if is_saved:
        scores.save(folder.gymnasium_scores, env_steps=run.policy_facts["env_steps"])


if __name__ == "__main__":
    cli.main(main)
