"""Where the time of training goes, against what physics alone and the networks' products alone would take."""

import math
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core

from mjx_walk.training.trainer import make_chunk, make_init
from mjx_walk.utils.types import Algorithm, Metrics, TrainState


def steps_per_second(advance: Callable[[Any], Any], carry: Any, steps_per_call: int, seconds: float) -> float:
    """Time repeated calls of `carry → carry`, the first of which compiles and is not counted."""
    return steps_per_call / _seconds_per_call(advance, carry, seconds)[1]


def _seconds_per_call(advance: Callable[[Any], Any], carry: Any, seconds: float) -> tuple[Any, float]:
    carry = jax.block_until_ready(advance(carry))
    start, calls = time.monotonic(), 0
    while time.monotonic() - start < seconds:
        carry = jax.block_until_ready(advance(carry))
        calls += 1
    return carry, (time.monotonic() - start) / calls


def time_parts(algorithm: Algorithm, iterations_per_call: int, fused: bool, seconds: float) -> dict[str, float]:
    """Seconds of collecting and of learning in one update.

    Collecting is timed in chunks that only collect: Warp records its kernels anew wherever its arrays lie at new
    addresses, as they do from call to call of a program that collects once.

    Args:
        algorithm: whose replay, if it has one, learns from the first step on.
        iterations_per_call: as the loop runs them.
        fused: see `make_chunk`.
        seconds: to measure each for.
    """

    def read(state: TrainState, batch: Any) -> tuple[TrainState, Metrics]:
        return state, {"all": jnp.stack([jnp.sum(x, dtype=jnp.float32) for x in jax.tree.leaves(batch)]).sum()}

    only_collect = make_chunk(algorithm._replace(learn=read), iterations_per_call, fused)
    state = make_init(algorithm)(jax.random.PRNGKey(0))
    state, collecting = _seconds_per_call(lambda state: only_collect(state)[0], state, seconds)
    state, batch = jax.jit(algorithm.collect, donate_argnums=0)(state)
    learn = jax.jit(algorithm.learn, donate_argnums=0)
    _, learning = _seconds_per_call(lambda state: learn(state, batch)[0], state, seconds)
    return {"collecting": collecting / iterations_per_call, "learning": learning}


def learning_flops(algorithm: Algorithm) -> float:
    """Floating-point operations of the matrix products in one update."""
    state = jax.eval_shape(make_init(algorithm), jax.random.PRNGKey(0))
    state, batch = jax.eval_shape(algorithm.collect, state)
    return matmul_flops(algorithm.learn, state, batch)


def matmul_flops(function: Callable, *arguments: Any) -> float:
    """Floating-point operations of the matrix products in one call; of a branch's alternatives the largest counts, and
    the body of a loop whose length is not known once.

    Args:
        function: traceable.
        arguments: arrays or their shapes.
    """
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(jaxpr: core.Jaxpr) -> float:
    return sum(_count_equation(equation) for equation in jaxpr.eqns)


def _count_equation(equation: core.JaxprEqn) -> float:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        left: Any = equation.invars[0].aval
        product: Any = equation.outvars[0].aval
        return 2.0 * math.prod(product.shape) * math.prod(left.shape[axis] for axis in contracted)
    if name == "cond":
        return max(_count(branch.jaxpr) for branch in params["branches"])
    inner = sum(_count(getattr(value, "jaxpr", value)) for value in params.values() if _is_jaxpr(value))
    return inner * params.get("length", 1) if name == "scan" else inner


def _is_jaxpr(value: Any) -> bool:
    return isinstance(value, core.Jaxpr | core.ClosedJaxpr)


def matmul_speed(dtype: str, seconds: float) -> float:
    """Floating-point operations a second of a large square matrix product on this device, at the precision set."""
    size = 8192 if jax.default_backend() != "cpu" else 1024
    matrix = jax.random.normal(jax.random.PRNGKey(0), (size, size), dtype)
    product = jax.jit(lambda a: jax.lax.fori_loop(0, 10, lambda _, a: (a @ matrix) / size**0.5, a))
    return steps_per_second(product, matrix, 10 * 2 * size**3, seconds)
