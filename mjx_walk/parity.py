"""`python -m mjx_walk.parity`: how far an MJX engine is from MuJoCo's C library, one step at a time.

Long free-running trajectories prove nothing once a body has fallen: CPU Gymnasium diverges from itself after a
perturbation of 1e-7. So every step starts anew from a state on a C trajectory.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk import cli
from mjx_walk.envs import TASKS, State, Task, make_env
from mjx_walk.settings import setting

USAGE = """
usage: python -m mjx_walk.parity [physics=warp|jax] [env=all] [version=v5] [copies=32] [steps=60] [seed=0]

Compares one environment step, from standing, airborne and fallen states, with the c engine. The reference runs on the
CPU. Exits with 1 if a tolerance is exceeded.
"""

TOLERANCES = {"qpos": (1e-6, 2e-5), "qvel": (5e-5, 2e-3), "other": (1e-4, 1e-2)}
"""Median and 99th percentile of each step's worst element: absolute for the physics state, relative for observation
blocks and rewards."""

AIRBORNE_HEIGHT = 1.0
"""A third of the copies start this much higher, m."""


@dataclasses.dataclass
class Arguments:
    physics: str = setting("warp", choices=("warp", "jax"))
    env: str = setting("all", choices=("all", *TASKS))
    version: str = setting("v5", choices=("v5", "v4"))
    copies: int = setting(32, at_least=3)
    steps: int = setting(60, at_least=1)
    seed: int = setting(0, at_least=0)


@dataclasses.dataclass(frozen=True)
class Error:
    """The error of one quantity, of each step its worst element, over all steps compared."""

    name: str
    median: float
    p99: float
    limits: tuple[float, float]

    @property
    def is_within(self) -> bool:
        return self.median <= self.limits[0] and self.p99 <= self.limits[1]

    def __str__(self) -> str:
        verdict = "" if self.is_within else f"   EXCEEDS {self.limits[0]:.0e}, {self.limits[1]:.0e}"
        return f"  {self.name:<18} median {self.median:.1e}   99% {self.p99:.1e}{verdict}"


@dataclasses.dataclass(frozen=True)
class Parity:
    """The outcome of one comparison."""

    errors: list[Error]
    num_steps: int
    num_terminations: int
    """Steps that ended an episode in the reference."""
    termination_mismatches: int
    overflows: int
    nonfinite: int
    """Steps whose physics broke in the engine; the state before them is kept, and each counts as terminated."""

    @property
    def is_within(self) -> bool:
        return all(error.is_within for error in self.errors) and not (self.termination_mismatches or self.overflows)


def reference_states(task: Task, num_copies: int, num_steps: int, seed: int) -> tuple[State, jax.Array]:
    """States on C trajectories under random actions, and the action taken from each.

    A third of the copies starts in the air; none is reset, so all lie on the floor in the end.

    Returns:
        `[num_steps · num_copies, …]`.
    """
    start_key, action_key = jax.random.split(jax.random.PRNGKey(seed))
    start = jax.vmap(task.reset)(jax.random.split(start_key, num_copies)).physics
    height = 2 if task.options.name.startswith("humanoid") else 1
    lift = jnp.where(jnp.arange(num_copies) % 3 == 0, AIRBORNE_HEIGHT, 0.0)
    state = jax.vmap(task.reset_to)(start.qpos.at[:, height].add(lift), start.qvel)

    def one(state, key):
        action = jax.random.uniform(
            key, (num_copies, task.action_size), minval=task.action_low, maxval=task.action_high
        )
        return jax.vmap(task.step)(state, action), (state, action)

    _, visited = jax.lax.scan(one, state, jax.random.split(action_key, num_steps))
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), visited)


def one_step(task: Task, states: State, actions: jax.Array) -> State:
    """The states, `[N, …]`, after one step, on the host."""
    return jax.device_get(jax.jit(jax.vmap(task.step))(states, actions))


def compare(task: Task, expected: State, found: State) -> Parity:
    """Hold two engines' outcomes of the same steps against each other.

    Args:
        task: on either engine.
        expected: `[N, …]`, the reference's.
        found: `[N, …]`, the engine's.
    """
    errors = [
        _error("qpos", expected.physics.qpos, found.physics.qpos, "qpos", is_relative=False),
        _error("qvel", expected.physics.qvel, found.physics.qvel, "qvel", is_relative=False),
    ]
    start = 0
    for name, size in task.observation_blocks().items():
        block = np.s_[:, start : start + size]
        errors.append(_error(f"obs {name}", expected.obs[block], found.obs[block]))
        start += size
    for name in task.reward_terms:
        errors.append(_error(name, expected.metrics[name][:, None], found.metrics[name][:, None]))
    errors.append(_error("reward", expected.reward[:, None], found.reward[:, None]))
    return Parity(
        errors,
        num_steps=len(expected.reward),
        num_terminations=int(expected.terminated.sum()),
        termination_mismatches=int((expected.terminated != found.terminated).sum()),
        overflows=int(found.metrics["overflow"].sum()),
        nonfinite=int(found.metrics["nonfinite"].sum()),
    )


def _error(name: str, expected: jax.Array, found: jax.Array, kind: str = "other", is_relative: bool = True) -> Error:
    difference = np.abs(np.float64(found) - expected)
    if is_relative:
        difference /= 1.0 + np.abs(expected)
    worst = difference.max(axis=1)
    return Error(name, float(np.median(worst)), float(np.quantile(worst, 0.99)), TOLERANCES[kind])


def check(name: str, version: str, physics: str, num_copies: int, num_steps: int, seed: int = 0) -> Parity:
    """Compare one task on one engine with the reference, which runs on the CPU whatever the engine runs on."""
    cpu = jax.local_devices(backend="cpu")[0]
    with jax.default_device(cpu):
        reference = make_env(name, physics="c", version=version)
        states, actions = jax.device_get(reference_states(reference, num_copies, num_steps, seed))
        expected = one_step(reference, states, actions)
    engine = make_env(name, physics=physics, version=version)
    return compare(engine, expected, one_step(engine, states, actions))


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
