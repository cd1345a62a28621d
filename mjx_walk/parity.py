"""`python -m mjx_walk.parity`: compare the MJX engines with MuJoCo's C library, one step at a time."""

import dataclasses
import sys
import warnings

from mjx_walk.cli import parsing
from mjx_walk.envs import GYMNASIUM_TASKS, TASKS, make_env
from mjx_walk.evaluation.engine_parity import check
from mjx_walk.evaluation.random_steps import take_random_steps
from mjx_walk.machine.devices import default_device
from mjx_walk.utils.setting_fields import MAX_SEED, setting

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.parity [physics=warp|jax] [env=all] [version=v5] [num_envs=32] [steps=60] [seed=0]
                                 [random_steps=10_000_000]

Compares one environment step with the c engine, from standing, airborne, thrown and fallen states. The reference runs
on the CPU. Exits with 1 if an error exceeds its tolerance.

  random_steps  only take this many steps with random actions, and count those in which a buffer of the physics
                overflows or a state is not finite; num_envs is then 4096 unless given
"""


@dataclasses.dataclass
class Arguments:
    physics: str = setting("warp", choices=("warp", "jax"))
    env: str = setting("all", choices=("all", *GYMNASIUM_TASKS))
    version: str = setting("v5", choices=("v5", "v4"))
    num_envs: int | None = setting(None, at_least=3)
    steps: int = setting(60, at_least=1)
    seed: int = setting(0, at_least=0, at_most=MAX_SEED)
    random_steps: int = setting(0, at_least=0)


def main(command_line: list[str]) -> int:
    """Print a table for each task. Returns 1 if an error exceeds its tolerance."""
    arguments = parsing.parse(Arguments, [_with_present_name(argument) for argument in command_line], USAGE)
    is_within = True
    one = _random_steps if arguments.random_steps else _single_steps
    every = [name for name in GYMNASIUM_TASKS if arguments.version in TASKS[name][0].XML_FILES]
    for name in every if arguments.env == "all" else (arguments.env,):
        is_within &= one(name, arguments)
    print("within tolerance" if is_within else "EXCEEDS its tolerance", file=sys.stderr)
    return 0 if is_within else 1


def _single_steps(name: str, arguments: Arguments) -> bool:
    """Print the table of one task. Returns whether every error is within its tolerance."""
    version, physics = arguments.version, arguments.physics
    parity = check(name, version, physics, arguments.num_envs or 32, arguments.steps, arguments.seed)
    print(f"{name} {version}, {physics} on {default_device().device_kind}: {parity.num_steps} steps")
    print(*parity.errors, sep="\n")
    print(
        f"  {parity.num_terminations} terminations, {parity.termination_mismatches} mismatches; "
        f"{parity.overflows} overflows, {parity.nonfinite} not finite",
        flush=True,
    )
    return parity.is_within


def _random_steps(name: str, arguments: Arguments) -> bool:
    """Print the counts of one task. Returns whether no step overflowed or broke."""
    task = make_env(name, physics=arguments.physics, version=arguments.version)
    taken = take_random_steps(task, arguments.num_envs or 4096, arguments.random_steps, arguments.seed)
    where = f"{name} {arguments.version}, {arguments.physics} on {default_device().device_kind}"
    counts = f"{taken.num_steps:,} steps, {taken.overflows} overflows, {taken.nonfinite} not finite"
    print(f"{where}: {counts}", flush=True)
    return not (taken.overflows or taken.nonfinite)


def _with_present_name(argument: str) -> str:
    """Translate the former name of `num_envs`, with a warning."""
    if not argument.startswith("copies="):
        return argument
    warnings.warn("copies is now num_envs", stacklevel=2)
    return argument.replace("copies", "num_envs", 1)


if __name__ == "__main__":
    parsing.main(main)
