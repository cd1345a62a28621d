"""`python -m mjx_walk.parity`: the MJX engines against MuJoCo's C library, one step at a time."""

import dataclasses
import sys

import jax

from mjx_walk.envs import TASKS
from mjx_walk.evaluation.parity import check
from mjx_walk.utils import cli
from mjx_walk.utils.settings import setting

USAGE = """
usage: python -m mjx_walk.parity [physics=warp|jax] [env=all] [version=v5] [copies=32] [steps=60] [seed=0]

Compares one environment step, from standing, airborne and fallen states, with the c engine. The reference runs on the
CPU. Exits with 1 if a tolerance is exceeded.
"""


@dataclasses.dataclass
class Arguments:
    physics: str = setting("warp", choices=("warp", "jax"))
    env: str = setting("all", choices=("all", *TASKS))
    version: str = setting("v5", choices=("v5", "v4"))
    copies: int = setting(32, at_least=3)
    steps: int = setting(60, at_least=1)
    seed: int = setting(0, at_least=0)


def main(arguments: list[str]) -> int:
    """Print a table for each task. Returns 1 if a tolerance is exceeded."""
    parsed = cli.parse(Arguments, arguments, USAGE)
    is_within = True
    for name in TASKS if parsed.env == "all" else (parsed.env,):
        parity = check(name, parsed.version, parsed.physics, parsed.copies, parsed.steps, parsed.seed)
        print(f"{name} {parsed.version}, {parsed.physics} on {jax.devices()[0].device_kind}: {parity.num_steps} steps")
        print(*parity.errors, sep="\n")
        print(
            f"  {parity.num_terminations} terminations, {parity.termination_mismatches} mismatches; "
            f"{parity.overflows} overflows, {parity.nonfinite} not finite",
            flush=True,
        )
        is_within &= parity.is_within
    print("within tolerance" if is_within else "EXCEEDS its tolerance", file=sys.stderr)
    return 0 if is_within else 1


if __name__ == "__main__":
    cli.main(main)
