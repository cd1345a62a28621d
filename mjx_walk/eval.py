"""`python -m mjx_walk.eval run=RUN_DIR`: score a run's policy without noise."""

import dataclasses

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting

USAGE = """
usage: python -m mjx_walk.eval run=RUN_DIR|zoo:NAME [episodes=100] [backend=gymnasium|sim] [seed=0] [physics=ENGINE]

  backend=gymnasium   the real environment, on the CPU; writes eval_gymnasium.json into the run folder
  backend=sim         the run's own engine, or another one by physics=
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    episodes: int = setting(100, at_least=1)
    backend: str = setting("gymnasium", choices=("gymnasium", "sim"))
    seed: int = setting(0, at_least=0)
    physics: str | None = None


def main(arguments: list[str]) -> None:
    """Evaluate and print."""
    parsed = cli.parse(Arguments, arguments, USAGE)
    if parsed.physics and parsed.backend == "gymnasium":
        raise UserError(f"physics={parsed.physics} needs backend=sim: Gymnasium has an engine of its own")
    folder = zoo.open_run(parsed.run)
    run = load_run(folder.path, parsed.physics)
    is_kept = parsed.backend == "gymnasium" and not zoo.holds(folder.path)
    if is_kept:
        cli.check_writable(folder.gymnasium_scores)
    scores = run.evaluate(parsed.episodes, parsed.backend, parsed.seed)
    print(scores)
    if is_kept:
        scores.save(folder.gymnasium_scores, env_steps=run.policy_facts["env_steps"])


if __name__ == "__main__":
    cli.main(main)
