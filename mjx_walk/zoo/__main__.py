"""`python -m mjx_walk.zoo`: list the policies that the package ships, or add a run's policy to them."""

import dataclasses
import re

import jax

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.cli import parsing
from mjx_walk.settings.saved_config import save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.scores import BEST, write_scores
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import PolicyParams

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.zoo
       python -m mjx_walk.zoo add=RUN_DIR name=NAME [num_runs=1 runs_mean=SCORE]

  The first form lists the policies. The second one, for the package's authors, scores a run's best policy on new
  episodes and adds it.
  num_runs    runs of which this one scored best
  runs_mean   the mean score of these runs; by default this run's own
"""

_FIRST_SEED = 10_000
"""Of the 100 scored episodes. Nobody has chosen a policy, a seed or a recipe on them."""


@dataclasses.dataclass
class Arguments:
    add: str | None = None
    name: str | None = None
    num_runs: int = setting(1, at_least=1)
    runs_mean: float | None = None


def main(command_line: list[str]) -> None:
    """List the policies, or add one."""
    arguments = parsing.parse(Arguments, command_line, USAGE)
    if arguments.add is None:
        if arguments.name is not None:
            raise UserError(f"name={arguments.name} needs add=RUN_DIR, the run to add under this name")
        print(zoo.table())
        return
    if arguments.name is None:
        raise UserError("say under which name: name=humanoid-ppo")
    if not re.fullmatch(r"[\w-]+", arguments.name):
        raise UserError(f"name={arguments.name}: use only letters, digits, '_' and '-'")
    run = load_run(arguments.add, "auto")
    run.policy_params = _rounded_to(run.config.algo.network_dtype, run.policy_params)
    scores = run.evaluate(seed=_FIRST_SEED)
    folder = zoo.empty_folder(arguments.name)
    config = dataclasses.replace(run.config, physics="auto", run_dir=None, resume=False)
    save_config(config, folder.config)
    checkpoint.save(folder.policy(BEST), run.policy_params, run.policy_metadata, as_numpy=True)
    write_scores(
        folder.gymnasium_scores,
        scores.env,
        {BEST: scores.block(**run.policy_metadata)},
        {
            "command": run.command,
            "num_runs": arguments.num_runs,
            "runs_mean": scores.mean if arguments.runs_mean is None else arguments.runs_mean,
        },
    )
    print(scores)


def _rounded_to(dtype: str, policy_params: PolicyParams) -> PolicyParams:
    """Round weights to the precision that the networks learned with; the zeros of bfloat16 compress well."""
    normalizer, params = policy_params
    return normalizer, jax.tree.map(lambda x: x.astype(dtype).astype(x.dtype), params)


if __name__ == "__main__":
    parsing.main(main)
