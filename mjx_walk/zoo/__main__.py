"""`python -m mjx_walk.zoo`: list the policies that the package ships, or add a run's policy to them."""

import dataclasses
import re
from typing import Any

import jax

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import save_config, training_command
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError

USAGE = """
usage: python -m mjx_walk.zoo                          list the policies
       python -m mjx_walk.zoo add=RUN_DIR name=NAME    score a run's policy and add it; for the package's authors
"""


@dataclasses.dataclass
class Arguments:
    add: str | None = None
    name: str | None = None


def main(command_line: list[str]) -> None:
    """List the policies, or add one."""
    arguments = cli.parse(Arguments, command_line, USAGE)
    if arguments.add is None:
        print(zoo.table())
        return
    if arguments.name is None:
        raise UserError("say under which name: name=humanoid-ppo")
    if not re.fullmatch(r"[\w-]+", arguments.name):
        raise UserError(f"name={arguments.name}: use only letters, digits, '_' and '-'")
    run = load_run(arguments.add, "auto")
    run.policy_params = _rounded_to(run.config.algo.network_dtype, run.policy_params)
    scores = run.evaluate()
    folder = zoo.empty_folder(arguments.name)
    config = dataclasses.replace(run.config, physics="auto", run_dir=None, resume=False)
    save_config(config, folder.config)
    facts = {"env_steps": run.policy_facts["env_steps"]}
    checkpoint.save(folder.best_policy, run.policy_params, facts, as_numpy=True)
    scores.save(folder.gymnasium_scores, command=training_command(config), **facts)
    print(scores)


def _rounded_to(dtype: str, policy_params: Any) -> Any:
    """Round weights to the precision that the networks learned with; the zeros of bfloat16 compress well."""
    normalizer, params = policy_params
    return normalizer, jax.tree.map(lambda x: x.astype(dtype).astype(x.dtype), params)


if __name__ == "__main__":
    cli.main(main)
