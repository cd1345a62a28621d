"""Costs of a program, counted in its traced form: operations of matrix products, and data reduced over devices."""

import math
from collections.abc import Callable
from typing import Any

import jax
from jax.extend import core

from mjx_walk.algos import Algorithm
from mjx_walk.envs.physics import nothing_runs
from mjx_walk.utils.collectives import DEVICES
from mjx_walk.utils.types import PyTree

__all__ = ["learning_flops", "matmul_flops", "reduced_bytes"]

_REDUCTIONS = ("psum", "pmax", "all_gather")


def learning_flops(algorithm: Algorithm) -> float:
    """Floating-point operations of the matrix products in one iteration."""
    return matmul_flops(algorithm.learn, *_learning_inputs(algorithm))


def matmul_flops(function: Callable, *arguments: PyTree) -> float:
    """Floating-point operations of the matrix products in one call.

    Of a conditional's branches only the most expensive one counts. The body of a loop of unknown length counts once.

    Args:
        function: traceable.
        arguments: arrays or their shapes.
    """
    return _total(jax.make_jaxpr(function)(*arguments).jaxpr, _product_flops)


def reduced_bytes(algorithm: Algorithm, num_devices: int) -> float:
    """Bytes that each device gives to the reductions over devices in one iteration. Counts as `matmul_flops` does.

    Args:
        algorithm: algorithm with the axis name `DEVICES`.
        num_devices: number of devices.
    """
    trace = jax.make_jaxpr(algorithm.learn, axis_env=[(DEVICES, num_devices)])
    return _total(trace(*_learning_inputs(algorithm)).jaxpr, _bytes_given)


def _learning_inputs(algorithm: Algorithm) -> tuple[PyTree, PyTree]:
    """Shapes of the arguments of `learn`."""
    shapes = algorithm.state_shapes()
    with nothing_runs():
        return jax.eval_shape(algorithm.collect, shapes)


def _total(jaxpr: core.Jaxpr, cost: Callable[[core.JaxprEqn], float]) -> float:
    """The summed cost of the equations, each as often as it runs."""
    return sum(_of_equation(equation, cost) for equation in jaxpr.eqns)


def _of_equation(equation: core.JaxprEqn, cost: Callable[[core.JaxprEqn], float]) -> float:
    name, params = equation.primitive.name, equation.params
    if name == "cond":
        return max(_total(branch.jaxpr, cost) for branch in params["branches"])
    bodies = [value.jaxpr if isinstance(value, core.ClosedJaxpr) else value for value in params.values()]
    inner = sum(_total(body, cost) for body in bodies if isinstance(body, core.Jaxpr))
    return cost(equation) + inner * (params.get("length", 1) if name == "scan" else 1)


def _product_flops(equation: core.JaxprEqn) -> float:
    if equation.primitive.name != "dot_general":
        return 0.0
    (contracted, _), _ = equation.params["dimension_numbers"]
    left: Any = equation.invars[0].aval
    product: Any = equation.outvars[0].aval
    return 2.0 * math.prod(product.shape) * math.prod(left.shape[axis] for axis in contracted)


def _bytes_given(equation: core.JaxprEqn) -> float:
    if equation.primitive.name not in _REDUCTIONS:
        return 0.0
    given: list[Any] = [x.aval for x in equation.invars]
    return float(sum(x.size * x.dtype.itemsize for x in given))
