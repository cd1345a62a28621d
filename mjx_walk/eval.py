"""`python -m mjx_walk.eval run=RUN_DIR`: score a policy of a run, without exploration noise."""

import dataclasses
import warnings

from mjx_walk import zoo
from mjx_walk.api import Run, load_run
from mjx_walk.cli import parsing
from mjx_walk.envs import require_model
from mjx_walk.evaluation.robustness import measure_robustness
from mjx_walk.evaluation.saved_policies import default_policy, kept_policies
from mjx_walk.settings.own_tasks import take_task
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import POLICIES, Scores, read_scores, write_scores
from mjx_walk.training.messages import choice_line, score_lines
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import MAX_SEED, setting

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.eval run=RUN_DIR|zoo:NAME [policy=NAME] [episodes=100] [backend=gymnasium|sim] [seed=0]
                               [physics=ENGINE]
       python -m mjx_walk.eval run=RUN_DIR|zoo:NAME robustness=true [policy=NAME] [episodes=20] [seed=0]

  policy=final        the newest policy; the default, except for runs that keep only the best one, such as the zoo's
  policy=best         the policy with the highest evaluation during training, which play and export take by default
  policy=medium       about two thirds of the way from the first evaluation to the best one; policy=simple is at one
                      third. A training with checkpoint.milestones=true keeps them.
  backend=gymnasium   the real environment, on the CPU; writes eval_gymnasium.json into the run folder
  backend=sim         the run's own engine, or the one given by physics=
  seed=N              episode i is reset with N + i, so seeds that differ by fewer than `episodes` share episodes; with
                      backend=sim, every seed has episodes of its own
  robustness=true     scores under changed friction, mass and torque, late actions and pushes, in 26 cells of `episodes`
                      each; writes robustness.json and robustness.png into the run folder or, for a policy of the zoo,
                      NAME.json and NAME.png into the current one
  env.task=FILE.py:CLASS   the task of the run, if it is your own and you have not named its file before
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    policy: str | None = setting(None, choices=POLICIES)
    episodes: int | None = setting(None, at_least=1)
    backend: str = setting("gymnasium", choices=("gymnasium", "sim"))
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)
    physics: str | None = None
    robustness: bool = False


_EPISODES, _EPISODES_OF_A_CELL = 100, 20


def main(command_line: list[str]) -> None:
    """Score the policy, print the result, and save a Gymnasium score in the run folder."""
    arguments = parsing.parse(Arguments, take_task(command_line), USAGE)
    if arguments.physics and arguments.backend == "gymnasium":
        raise UserError(f"physics={arguments.physics} needs backend=sim: Gymnasium has its own engine")
    folder = zoo.open_run(arguments.run)
    name = arguments.policy or default_policy(folder)
    if arguments.robustness:
        _measure_robustness(arguments, folder, name)
        return
    run = load_run(folder.path, arguments.physics, name)
    is_saved = arguments.backend == "gymnasium" and not zoo.holds(folder.path)
    if is_saved:
        parsing.check_writable(folder.gymnasium_scores)
    scores = run.evaluate(arguments.episodes or _EPISODES, arguments.backend, arguments.seed)
    print(*score_lines({run.policy_name: (scores, run.policy_metadata["env_steps"])}), sep="\n")
    if arguments.policy is None and len(kept_policies(folder)) > 1:
        print(choice_line(run.policy_name))
    if is_saved:
        _save(folder, run, scores)


def _measure_robustness(arguments: Arguments, folder: RunFolder, policy: str) -> None:
    """Score the policy under changed physics, print a table, and write it as JSON and as a figure."""
    from mjx_walk.viewing.robustness_figure import draw_robustness  # imports Matplotlib, which slows the start

    if arguments.backend != "gymnasium":
        raise UserError("robustness=true plays in Gymnasium; leave out backend=sim")
    table, figure = zoo.output_path(folder, "robustness.json"), zoo.output_path(folder, "robustness.png")
    for path in (table, figure):
        parsing.check_writable(path)
    run = load_run(folder.path, policy=policy)
    episodes = arguments.episodes or _EPISODES_OF_A_CELL
    robustness = measure_robustness(require_model(run.task), run.act, episodes, arguments.seed)
    print(
        f"{run.policy_name.capitalize()} policy (step {run.policy_metadata['env_steps']:,})",
        *robustness.lines(),
        sep="\n",
    )
    robustness.write(table)
    draw_robustness(robustness, figure)
    print(table, figure, sep="\n")


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
