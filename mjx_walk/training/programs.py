"""Compiled programs: one run, several seeds in one program, or several devices that train one run.

The trainer calls their functions and does not know which of them it runs.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.algos import Algorithm, TrainState, is_finite
from mjx_walk.utils.types import Metrics

Step = Callable[[TrainState], tuple[TrainState, Metrics]]
Lower = Callable[[list[jax.Array], TrainState | None], list[jax.stages.Lowered]]
"""`(keys of the runs, restored state) → programs`. Once they are compiled, a call does not compile them again."""


class Program(NamedTuple):
    """The functions of one or several runs. A state of several runs has an axis of runs in front."""

    init: Callable[[list[jax.Array]], TrainState]
    """`keys of the runs → state`."""
    step: Step
    """One call: `state → (state, metrics)`, several iterations. It consumes the state."""
    lower: Lower
    """Traces the programs of `step`, and without a restored state also that of `init`."""
    split: Callable[[TrainState], list[TrainState]]
    """The state of each run, without an axis in front; on the host if there was one."""
    merge: Callable[[list[TrainState]], TrainState]
    """The inverse of `split`."""
    policies: Callable[[TrainState], list[Any]]
    """The policy parameters of each run."""
    split_metrics: Callable[[Metrics], list[Metrics]]
    """The metrics of each run, on the host, `[iterations]` each."""
    is_finite: Callable[[TrainState], np.ndarray]
    """`[runs] bool`: whether each run's learned leaves are finite."""
    max_over_processes: Callable[[int], int]
    """The largest of the numbers that the processes pass."""


def make_init(init: Callable[[jax.Array], TrainState]) -> jax.stages.Wrapped:
    """Compile `key → TrainState` without weak types, with which the first call would compile twice."""

    def strong(key):
        return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), init(key))

    return jax.jit(strong)


class CompiledStep(Protocol):
    """A step that is compiled when it is first called, or before from what it lowers."""

    def __call__(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """One call."""
        ...

    def lower(self, state: TrainState) -> list[jax.stages.Lowered]:
        """Trace the step's programs for a state or its shapes."""
        ...


def make_step(collect: Callable, learn: Callable, iterations_per_call: int, fused: bool) -> CompiledStep:
    """Make a step of several iterations.

    Args:
        collect: `TrainState → (TrainState, batch)`.
        learn: `(TrainState, batch) → (TrainState, metrics)`.
        iterations_per_call: iterations of a call.
        fused: compile both into one program. Engines that call back to the host need separate programs, because JAX
            does not keep programs with callbacks in its compile cache.
    """
    return (_OneProgram if fused else _TwoPrograms)(collect, learn, iterations_per_call)


class _OneProgram:
    def __init__(self, collect: Callable, learn: Callable, iterations_per_call: int):
        def iterate(state, _):
            return learn(*collect(state))

        self._call = jax.jit(lambda state: jax.lax.scan(iterate, state, length=iterations_per_call), donate_argnums=0)

    def __call__(self, state: TrainState) -> tuple[TrainState, Metrics]:
        return self._call(state)

    def lower(self, state: TrainState) -> list[jax.stages.Lowered]:
        return [self._call.lower(state)]


class _TwoPrograms:
    def __init__(self, collect: Callable, learn: Callable, iterations_per_call: int):
        self._collect = jax.jit(collect, donate_argnums=0)
        self._learn = jax.jit(learn, donate_argnums=0)
        self._iterations_per_call = iterations_per_call

    def __call__(self, state: TrainState) -> tuple[TrainState, Metrics]:
        rows = []
        for _ in range(self._iterations_per_call):
            state, metrics = self._learn(*self._collect(state))
            rows.append(metrics)
        return state, jax.tree.map(lambda *xs: jnp.stack(xs), *rows)

    def lower(self, state: TrainState) -> list[jax.stages.Lowered]:
        return [self._collect.lower(state), self._learn.lower(*jax.eval_shape(self._collect, state))]


def _lower(
    init: jax.stages.Wrapped, step: CompiledStep, keys: jax.Array, restored: TrainState | None
) -> list[jax.stages.Lowered]:
    if restored is not None:
        return step.lower(restored)
    return [init.lower(keys), *step.lower(jax.eval_shape(init, keys))]


def compile_together(programs: list[jax.stages.Lowered]) -> None:
    """Compile each program in a thread of its own."""
    with ThreadPoolExecutor() as pool:
        for compiling in [pool.submit(program.compile) for program in programs]:
            compiling.result()


def make_single_program(algorithm: Algorithm, iterations_per_call: int, fused: bool) -> Program:
    """One run on one device."""
    check = jax.jit(is_finite)
    init = make_init(algorithm.init)
    step = make_step(algorithm.collect, algorithm.learn, iterations_per_call, fused)
    return Program(
        init=lambda keys: init(keys[0]),
        step=step,
        lower=lambda keys, restored: _lower(init, step, keys[0], restored),
        split=lambda state: [state],
        merge=lambda states: states[0],
        policies=lambda state: [algorithm.policy_params(state)],
        split_metrics=lambda metrics: [jax.device_get(metrics)],
        is_finite=lambda state: np.atleast_1d(check(state)),
        max_over_processes=lambda number: number,
    )


def make_seeds_program(algorithm: Algorithm, num_seeds: int, iterations_per_call: int, fused: bool) -> Program:
    """Several runs that differ in their seed, in one program on one device."""
    init = make_init(jax.vmap(algorithm.init))
    step = make_step(jax.vmap(algorithm.collect), jax.vmap(algorithm.learn), iterations_per_call, fused)
    return make_axis_program(
        algorithm,
        num_seeds,
        init=lambda keys: init(jnp.stack(keys)),
        step=step,
        lower=lambda keys, restored: _lower(init, step, jnp.stack(keys), restored),
        split_metrics=functools.partial(_split_metrics, num_seeds),
    )


def make_axis_program(
    algorithm: Algorithm,
    num_runs: int,
    init: Callable[[list[jax.Array]], TrainState],
    step: Step,
    lower: Lower,
    split_metrics: Callable[[Metrics], list[Metrics]],
    max_over_processes: Callable[[int], int] = lambda number: number,
) -> Program:
    """A program whose state has an axis of runs in front."""
    check = jax.jit(jax.vmap(is_finite))

    def policies(state: TrainState) -> list[Any]:
        params = algorithm.policy_params(state)
        return [jax.tree.map(lambda x, i=i: x[i], params) for i in range(num_runs)]

    def split(state: TrainState) -> list[TrainState]:
        state = jax.device_get(state)
        return [jax.tree.map(lambda x, i=i: x[i], state) for i in range(num_runs)]

    def merge(states: list[TrainState]) -> TrainState:
        # On the host, which has room for all of them twice.
        return jax.tree.map(lambda *xs: jnp.asarray(np.stack(xs)), *map(jax.device_get, states))

    return Program(
        init=init,
        step=step,
        lower=lower,
        split=split,
        merge=merge,
        policies=policies,
        split_metrics=split_metrics,
        is_finite=lambda state: np.asarray(check(state)),
        max_over_processes=max_over_processes,
    )


def _split_metrics(num_runs: int, metrics: Metrics) -> list[Metrics]:
    metrics = jax.device_get(metrics)
    return [jax.tree.map(lambda x, i=i: x[:, i], metrics) for i in range(num_runs)]
