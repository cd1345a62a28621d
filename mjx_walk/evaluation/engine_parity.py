"""Parity of an MJX engine with MuJoCo's C library, one step at a time.

Every step starts from a state on a C trajectory. Free-running trajectories prove nothing once a body has fallen: CPU
Gymnasium diverges from itself after a perturbation of 1e-7.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.envs import State, Task, make_env

__all__ = [
    "AIRBORNE_HEIGHT",
    "THROWN_SPEED",
    "TOLERANCES",
    "Error",
    "Parity",
    "check",
    "compare",
    "one_step",
    "reference_states",
]

TOLERANCES = {"qpos": (1e-6, 2e-5), "qvel": (5e-5, 2e-3), "other": (1e-4, 1e-2)}
"""Limits of the median and the 99th percentile of each step's worst element.

Errors of `qpos` and `qvel` are absolute; errors of observation blocks and rewards, `other`, are relative.
"""

AIRBORNE_HEIGHT = 1.0
"""A third of the environments start this much higher, m."""

THROWN_SPEED = 3.0
"""Where the root cannot leave the ground, a third start with normal velocities of this deviation, m/s and rad/s."""


@dataclasses.dataclass(frozen=True)
class Error:
    """The error of one quantity: statistics over all steps of each step's worst element."""

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
    """Result of comparing one engine with the reference."""

    errors: list[Error]
    num_steps: int
    num_terminations: int
    """Steps that ended an episode in the reference."""
    termination_mismatches: int
    overflows: int
    nonfinite: int
    """Steps whose physics broke in the engine. Each keeps the state before it and terminates."""

    @property
    def is_within(self) -> bool:
        return all(error.is_within for error in self.errors) and not (self.termination_mismatches or self.overflows)


def reference_states(task: Task, num_envs: int, num_steps: int, seed: int) -> tuple[State, jax.Array]:
    """States on C trajectories under random actions, and the action taken in each state.

    A third of the environments starts in the air or, where the root cannot leave the ground, thrown. None is reset, so
    all that can fall lie on the floor in the end.

    Returns:
        `[num_steps · num_envs, …]`.
    """
    start_key, action_key = jax.random.split(jax.random.PRNGKey(seed))
    start = jax.vmap(task.reset)(jax.random.split(start_key, num_envs)).physics
    is_thrown = jnp.arange(num_envs) % 3 == 0
    if task.HEIGHT_INDEX is None:
        speeds = THROWN_SPEED * jax.random.normal(jax.random.fold_in(start_key, 1), start.qvel.shape)
        start = start._replace(qvel=start.qvel + is_thrown[:, None] * speeds)
    else:
        start = start._replace(qpos=start.qpos.at[:, task.HEIGHT_INDEX].add(is_thrown * AIRBORNE_HEIGHT))
    state = jax.vmap(task.reset_to)(start.qpos, start.qvel)

    def one(state, key):
        action = jax.random.uniform(key, (num_envs, task.action_size), minval=task.action_low, maxval=task.action_high)
        return jax.vmap(task.step)(state, action), (state, action)

    _, visited = jax.lax.scan(one, state, jax.random.split(action_key, num_steps))
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), visited)


def one_step(task: Task, states: State, actions: jax.Array) -> State:
    """Step states `[N, …]` once, and copy the result to the host."""
    return jax.device_get(jax.jit(jax.vmap(task.step))(states, actions))


def compare(task: Task, expected: State, found: State) -> Parity:
    """Compare two engines after the same steps.

    Args:
        task: on either engine.
        expected: states of the reference, `[N, …]`.
        found: states of the engine, `[N, …]`.
    """
    errors = [
        _error("qpos", expected.physics.qpos, found.physics.qpos, is_relative=False),
        _error("qvel", expected.physics.qvel, found.physics.qvel, is_relative=False),
    ]
    if expected.physics.act is not None and found.physics.act is not None:
        errors.append(_error("act", expected.physics.act, found.physics.act))
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


def _error(name: str, expected: jax.Array, found: jax.Array, is_relative: bool = True) -> Error:
    difference = np.abs(np.float64(found) - expected)
    if is_relative:
        difference /= 1.0 + np.abs(expected)
    worst = difference.max(axis=1)
    limits = TOLERANCES.get(name, TOLERANCES["other"])
    return Error(name, float(np.median(worst)), float(np.quantile(worst, 0.99)), limits)


def check(name: str, version: str, physics: str, num_envs: int, num_steps: int, seed: int = 0) -> Parity:
    """Compare one task on one engine with the reference, which always runs on the CPU."""
    engine = make_env(name, physics=physics, version=version)
    cpu = jax.local_devices(backend="cpu")[0]
    with jax.default_device(cpu):
        reference = make_env(name, physics="c", version=version)
        states, actions = jax.device_get(reference_states(reference, num_envs, num_steps, seed))
        expected = one_step(reference, states, actions)
    return compare(engine, expected, one_step(engine, states, actions))
