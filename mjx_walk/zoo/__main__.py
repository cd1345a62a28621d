"""`python -m mjx_walk.zoo`: list the policies that come with the package; for its authors: put a run's among them."""

import dataclasses
import re
from typing import Any

import jax

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import save_config, training_command
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError

USAGE = """
usage: python -m mjx_walk.zoo                          list the policies
       python -m mjx_walk.zoo add=RUN_DIR name=NAME    score a run's policy and put it there
"""


@dataclasses.dataclass
class Arguments:
    add: str | None = None
    name: str | None = None


def main(arguments: list[str]) -> None:
    """List, or add."""
    parsed = cli.parse(Arguments, arguments, USAGE)
    if parsed.add is None:
        print(zoo.table())
        return
    if parsed.name is None:
        raise UserError("say under which name: name=humanoid-ppo")
    if not re.fullmatch(r"[\w-]+", parsed.name):
        raise UserError(f"name={parsed.name}: letters, digits, '_' and '-' make a name")
    source = zoo.open_run(parsed.add)
    run = load_run(source.path, "auto")
    run.policy_params = _rounded_to(run.config.algo.network_dtype, run.policy_params)
    scores = run.evaluate()
    folder = RunFolder(zoo.empty_folder(parsed.name))
    config = dataclasses.replace(run.config, physics="auto", run_dir=None, resume=False)
    save_config(config, folder.config)
    facts = {"env_steps": run.policy_facts["env_steps"]}
    checkpoint.save(folder.best_policy, run.policy_params, facts, as_numpy=True)
    scores.save(folder.gymnasium_scores, command=training_command(config), **facts)
    print(scores)


def _rounded_to(dtype: str, policy_params: Any) -> Any:
    """A policy with weights of the precision that its networks learned with: half the bytes of bfloat16 are zeros."""
    normalizer, params = policy_params
    return normalizer, jax.tree.map(lambda x: x.astype(dtype).astype(x.dtype), params)


if __name__ == "__main__":
    cli.main(main)
