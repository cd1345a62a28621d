"""Compiled programs: one run, several seeds in one program, or several devices that train one run.

The trainer calls their methods and does not know which of them it runs.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.algos import Algorithm, TrainState, is_finite
from mjx_walk.training.distributed import DevicesStep, Processes, init_on_device
from mjx_walk.utils.types import Metrics

__all__ = [
    "DevicesProgram",
    "FusedStep",
    "Program",
    "SeedsProgram",
    "SeparateSteps",
    "SingleProgram",
    "compile_together",
    "make_init",
    "make_program",
    "make_step",
]

_Tree = TypeVar("_Tree")

_is_finite = jax.jit(is_finite)
_are_finite = jax.jit(jax.vmap(is_finite))


class Program(Protocol):
    """The compiled functions of one or several runs. A state of several runs has an axis of runs in front."""

    def init(self, keys: list[jax.Array]) -> TrainState:
        """The state before the first iteration, from the key of each run."""
        ...

    def run_call(self, state: TrainState) -> tuple[TrainState, list[Metrics]]:
        """Collect and learn in each iteration of a call, and wait for the last one. It consumes the state.

        Returns:
            The new state, and the metrics of each run, on the host, `[iterations]` each.
        """
        ...

    def lower(self, keys: list[jax.Array], restored: TrainState | None) -> list[jax.stages.Lowered]:
        """Trace the programs of `run_call`, and without a restored state also that of `init`.

        Once they are compiled, a call does not compile them again. A program may leave out what it cannot trace yet.
        """
        ...

    def split(self, tree: _Tree) -> list[_Tree]:
        """Split a state, or a pytree from it, into one tree for each run. With an axis of runs, on the host."""
        ...

    def merge(self, states: list[TrainState]) -> TrainState:
        """The inverse of `split`."""
        ...

    def is_finite(self, state: TrainState) -> np.ndarray:
        """Whether each run's learned leaves are finite, `[runs] bool`."""
        ...


def make_program(algorithm: Algorithm, iterations_per_call: int, num_runs: int, processes: Processes) -> Program:
    """Choose the program of a training.

    Args:
        algorithm: the algorithm, with the axis name of the processes.
        iterations_per_call: iterations of a call.
        num_runs: runs that differ only in their seed; one if several processes train it.
        processes: processes that train one run together.
    """
    if processes.process_count > 1:
        return DevicesProgram(algorithm, iterations_per_call, processes)
    fused = not algorithm.task.engine.calls_host
    return (SeedsProgram if num_runs > 1 else SingleProgram)(algorithm, iterations_per_call, fused)


class SingleProgram:
    """One run on one device."""

    def __init__(self, algorithm: Algorithm, iterations_per_call: int, fused: bool):
        self._init = make_init(algorithm.init)
        self._step = make_step(algorithm.collect, algorithm.learn, iterations_per_call, fused)

    def init(self, keys: list[jax.Array]) -> TrainState:
        return self._init(keys[0])

    def run_call(self, state: TrainState) -> tuple[TrainState, list[Metrics]]:
        state, metrics = self._step(state)
        return state, [jax.device_get(metrics)]

    def lower(self, keys: list[jax.Array], restored: TrainState | None) -> list[jax.stages.Lowered]:
        return _lower(self._init, self._step, keys[0], restored)

    def split(self, tree: _Tree) -> list[_Tree]:
        return [tree]

    def merge(self, states: list[TrainState]) -> TrainState:
        return states[0]

    def is_finite(self, state: TrainState) -> np.ndarray:
        return np.atleast_1d(_is_finite(state))


class SeedsProgram:
    """Several runs that differ in their seed, in one program on one device."""

    def __init__(self, algorithm: Algorithm, iterations_per_call: int, fused: bool):
        self._init = make_init(jax.vmap(algorithm.init))
        collect, learn = jax.vmap(algorithm.collect), jax.vmap(algorithm.learn)
        self._step = make_step(collect, learn, iterations_per_call, fused)

    def init(self, keys: list[jax.Array]) -> TrainState:
        return self._init(jnp.stack(keys))

    def run_call(self, state: TrainState) -> tuple[TrainState, list[Metrics]]:
        state, metrics = self._step(state)
        return state, _unstack(metrics, axis=1)

    def lower(self, keys: list[jax.Array], restored: TrainState | None) -> list[jax.stages.Lowered]:
        return _lower(self._init, self._step, jnp.stack(keys), restored)

    def split(self, tree: _Tree) -> list[_Tree]:
        return _unstack(tree)

    def merge(self, states: list[TrainState]) -> TrainState:
        return _stack(states)

    def is_finite(self, state: TrainState) -> np.ndarray:
        return np.asarray(_are_finite(state))


class DevicesProgram:
    """One run on the devices of all processes. States have an axis of length one in front."""

    def __init__(self, algorithm: Algorithm, iterations_per_call: int, processes: Processes):
        self._init = make_init(functools.partial(init_on_device, algorithm, processes.process_index))
        self._step = DevicesStep(algorithm, iterations_per_call, processes)

    def init(self, keys: list[jax.Array]) -> TrainState:
        return self._init(keys[0])

    def run_call(self, state: TrainState) -> tuple[TrainState, list[Metrics]]:
        state, metrics = self._step(state)
        return state, _unstack(metrics)

    def lower(self, keys: list[jax.Array], restored: TrainState | None) -> list[jax.stages.Lowered]:
        # The step needs arrays over all devices.
        return [self._init.lower(keys[0])] if restored is None else []

    def split(self, tree: _Tree) -> list[_Tree]:
        return _unstack(tree)

    def merge(self, states: list[TrainState]) -> TrainState:
        return _stack(states)

    def is_finite(self, state: TrainState) -> np.ndarray:
        return np.asarray(_are_finite(state))


def _unstack(tree: _Tree, axis: int = 0) -> list[_Tree]:
    """The trees along an axis of runs, on the host."""
    tree = jax.tree.map(lambda x: np.moveaxis(x, axis, 0), jax.device_get(tree))
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(len(jax.tree.leaves(tree)[0]))]


def _stack(trees: list[_Tree]) -> _Tree:
    """The inverse of `_unstack`. It stacks on the host, which has room for all of them twice."""
    return jax.tree.map(lambda *xs: jnp.asarray(np.stack(xs)), *map(jax.device_get, trees))


def make_init(init: Callable[[jax.Array], TrainState]) -> jax.stages.Wrapped:
    """Compile `key → TrainState` without weak types. With them, the step would compile again in the second call."""
    return jax.jit(functools.partial(_strong_init, init))


def _strong_init(init: Callable[[jax.Array], TrainState], key: jax.Array) -> TrainState:
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), init(key))


class FusedStep:
    """A step of several iterations in one program."""

    def __init__(self, collect: Callable, learn: Callable, iterations_per_call: int):
        self._call = jax.jit(functools.partial(_iterate, collect, learn, iterations_per_call), donate_argnums=0)

    def __call__(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """One call, `[iterations]` metrics. It consumes the state."""
        return self._call(state)

    def lower(self, state: TrainState) -> list[jax.stages.Lowered]:
        """Trace the programs for a state or its shapes. Once compiled, a call does not compile them again."""
        return [self._call.lower(state)]


def _iterate(collect: Callable, learn: Callable, num_iterations: int, state: TrainState) -> tuple[TrainState, Metrics]:
    return jax.lax.scan(lambda state, _: learn(*collect(state)), state, length=num_iterations)


class SeparateSteps:
    """A step that runs two programs in every iteration: one collects, the other learns."""

    def __init__(self, collect: Callable, learn: Callable, iterations_per_call: int):
        self._collect = jax.jit(collect, donate_argnums=0)
        self._learn = jax.jit(learn, donate_argnums=0)
        self._iterations_per_call = iterations_per_call

    def __call__(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """One call, `[iterations]` metrics. It consumes the state."""
        rows = []
        for _ in range(self._iterations_per_call):
            state, metrics = self._learn(*self._collect(state))
            rows.append(metrics)
        return state, jax.tree.map(lambda *xs: jnp.stack(xs), *rows)

    def lower(self, state: TrainState) -> list[jax.stages.Lowered]:
        """Trace the programs for a state or its shapes. Once compiled, a call does not compile them again."""
        return [self._collect.lower(state), self._learn.lower(*jax.eval_shape(self._collect, state))]


def make_step(collect: Callable, learn: Callable, iterations_per_call: int, fused: bool) -> FusedStep | SeparateSteps:
    """Make a step of several iterations.

    Args:
        collect: `TrainState → (TrainState, batch)`.
        learn: `(TrainState, batch) → (TrainState, metrics)`.
        iterations_per_call: iterations of a call.
        fused: compile both into one program. Engines that call back to the host need separate programs, because JAX
            does not keep programs with callbacks in its compile cache.
    """
    return (FusedStep if fused else SeparateSteps)(collect, learn, iterations_per_call)


def _lower(
    init: jax.stages.Wrapped, step: FusedStep | SeparateSteps, keys: jax.Array, restored: TrainState | None
) -> list[jax.stages.Lowered]:
    if restored is not None:
        return step.lower(restored)
    return [init.lower(keys), *step.lower(jax.eval_shape(init, keys))]


def compile_together(programs: list[jax.stages.Lowered]) -> None:
    """Compile each program in a thread of its own."""
    with ThreadPoolExecutor() as pool:
        for compiling in [pool.submit(program.compile) for program in programs]:
            compiling.result()
