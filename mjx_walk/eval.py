"""`python -m mjx_walk.eval run=RUN_DIR`: score a policy of a run, without exploration noise."""

import dataclasses
import warnings

from mjx_walk import zoo
from mjx_walk.api import Run, load_run
from mjx_walk.cli import parsing
from mjx_walk.evaluation.saved_policies import default_policy, kept_policies
from mjx_walk.settings.own_tasks import take_task
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import POLICIES, Scores, read_scores, write_scores
from mjx_walk.training.messages import choice_line, score_lines
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import MAX_SEED, setting

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.eval run=RUN_DIR|zoo:NAME [policy=final|best] [episodes=100] [backend=gymnasium|sim] [seed=0]
                               [physics=ENGINE]

  policy=final        the newest policy; the default, except for runs that keep only the best one, such as the zoo's
  policy=best         the policy with the highest evaluation during training, which play and export take by default
  backend=gymnasium   the real environment, on the CPU; writes eval_gymnasium.json into the run folder
  backend=sim         the run's own engine, or the one given by physics=
  seed=N              episode i is reset with N + i, so seeds that differ by fewer than `episodes` share episodes; with
                      backend=sim, every seed has episodes of its own
  env.task=FILE.py:CLASS   the task of the run, if it is your own and you have not named its file before
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    policy: str | None = setting(None, choices=POLICIES)
    episodes: int = setting(100, at_least=1)
    backend: str = setting("gymnasium", choices=("gymnasium", "sim"))
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)
    physics: str | None = None


def main(command_line: list[str]) -> None:
    """Score the policy, print the result, and save a Gymnasium score in the run folder."""
    arguments = parsing.parse(Arguments, take_task(command_line), USAGE)
    if arguments.physics and arguments.backend == "gymnasium":
        raise UserError(f"physics={arguments.physics} needs backend=sim: Gymnasium has its own engine")
    folder = zoo.open_run(arguments.run)
    name = arguments.policy or default_policy(folder)
    run = load_run(folder.path, arguments.physics, name)
    is_saved = arguments.backend == "gymnasium" and not zoo.holds(folder.path)
    if is_saved:
        parsing.check_writable(folder.gymnasium_scores)
    scores = run.evaluate(arguments.episodes, arguments.backend, arguments.seed)
    print(*score_lines({run.policy_name: (scores, run.policy_metadata["env_steps"])}))
    if arguments.policy is None and len(kept_policies(folder)) > 1:
        print(choice_line(run.policy_name))
    if is_saved:
        _save(folder, run, scores)


def _save(folder: RunFolder, run: Run, scores: Scores) -> None:
    """Replace the policy's block of `eval_gymnasium.json`, and keep the other policy's."""
    blocks, metadata = {}, {}
    if folder.gymnasium_scores.exists():
        try:
            former = read_scores(folder.gymnasium_scores)
            blocks, metadata = former.blocks, former.metadata
        except ValueError as error:
            warnings.warn(f"{error}; it is replaced", stacklevel=2)
    own = {run.policy_name: scores.block(**run.policy_metadata)}
    write_scores(folder.gymnasium_scores, scores.env, blocks | own, metadata)


if __name__ == "__main__":
    parsing.main(main)
