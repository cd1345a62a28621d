"""Export of a policy to ONNX, translated from its jaxpr, so that the file computes exactly what JAX computes.

We do not use jax2onnx: its releases conflict with the Orbax version used here, or give graphs that onnxruntime rejects.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from jax.extend import core
from onnx import TensorProto, helper, numpy_helper

from mjx_walk.utils.errors import UserError

__all__ = ["DTYPES", "Value", "translate"]

_OPSET = 17
_UNARY = ("abs", "erf", "exp", "log", "neg", "not", "sign", "sqrt", "tanh")
_BINARY = ("add", "div", "max", "min", "mul", "pow", "sub")
_OPERATORS = {name: name.capitalize() for name in _UNARY + _BINARY} | {
    "eq": "Equal",
    "ge": "GreaterOrEqual",
    "gt": "Greater",
    "le": "LessOrEqual",
    "logistic": "Sigmoid",
    "lt": "Less",
}
"""JAX's primitives with an ONNX operator of the same meaning."""
_INLINED = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")
_SHAPES_ONLY = ("broadcast_in_dim", "reshape", "squeeze", "expand_dims", "copy", "stop_gradient")


DTYPES = {"float64": TensorProto.DOUBLE, "float32": TensorProto.FLOAT}
"""ONNX's types of the input, by NumPy's names. A model takes one of them: ONNX does not convert inputs."""


def translate(
    policy: Callable[[jax.Array], jax.Array], observation_size: int, name: str, dtype: str = "float64"
) -> onnx.ModelProto:
    """Translate a policy to ONNX.

    Args:
        policy: `[observation_size] f32 → [action_size] f32`, unbatched.
        observation_size: size of its input.
        name: of the graph.
        dtype: of the input. Gymnasium's observations are float64.

    Returns:
        A model with the input `observation`, `[N, observation_size]` of that dtype, and the output `action`,
        `[N, action_size] f32`, both in Gymnasium's units.

    Raises:
        UserError: the policy uses a primitive that has no translation.
    """
    closed = jax.make_jaxpr(policy)(jnp.zeros(observation_size))
    graph = _Graph()
    obs = graph.add("Cast", ["observation"], to=TensorProto.FLOAT)
    (action,) = graph.follow(closed.jaxpr, closed.consts, obs)
    graph.nodes.append(helper.make_node("Identity", [graph.name(action)], ["action"]))
    model = helper.make_model(
        helper.make_graph(
            graph.needed_for("action"),
            name,
            [helper.make_tensor_value_info("observation", DTYPES[dtype], ["N", observation_size])],
            [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", closed.out_avals[0].shape[-1]])],
            graph.initializers,
        ),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=8,
        producer_name="mjx_walk",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


Value = str | jax.Array | np.ndarray | np.generic
"""The name of a node's output, or an array."""


class _Graph:
    """The ONNX graph under construction.

    A `Value` that depends on the observation is the name of a node's output; any other is an array. Values that
    depend on the observation gain a leading batch axis: a vector is `[N, size]`, a scalar `[N, 1]`. ONNX then
    broadcasts them where JAX changes shapes.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []
        self._count = itertools.count()

    def add(self, kind: str, inputs: Sequence[Value], num_outputs: int = 1, **attributes: Any) -> list[str]:
        """Append a node and return the names of its outputs."""
        names = [f"v{next(self._count)}" for _ in range(num_outputs)]
        self.nodes.append(helper.make_node(kind, [self.name(x) for x in inputs], names, **attributes))
        return names

    def name(self, value: Value) -> str:
        """Name of a value; an array is stored in the model first."""
        if isinstance(value, str):
            return value
        self.initializers.append(numpy_helper.from_array(np.asarray(value), f"c{next(self._count)}"))
        return self.initializers[-1].name

    def needed_for(self, output: str) -> list[onnx.NodeProto]:
        """The nodes that an output depends on, in order. Arrays that they do not use are dropped."""
        wanted, kept = {output}, []
        for node in reversed(self.nodes):
            if wanted.intersection(node.output):
                wanted.update(node.input)
                kept.append(node)
        self.initializers = [array for array in self.initializers if array.name in wanted]
        return kept[::-1]

    def follow(self, jaxpr: core.Jaxpr, consts: Sequence[Value], arguments: Sequence[Value]) -> list[Value]:
        """Append the nodes of a jaxpr and return its outputs."""
        outputs: Sequence[Value]
        values: dict[core.Var, Value] = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *arguments), strict=True))
        for equation in jaxpr.eqns:
            inputs = _lookup(values, equation.invars)
            if equation.primitive.name in _INLINED:
                inner = next(equation.params[key] for key in ("jaxpr", "call_jaxpr") if key in equation.params)
                closed = inner if isinstance(inner, core.ClosedJaxpr) else core.ClosedJaxpr(inner, ())
                outputs = self.follow(closed.jaxpr, closed.consts, inputs)
            elif any(isinstance(value, str) for value in inputs):
                outputs = self._nodes(equation, inputs)
            else:
                found = equation.primitive.bind(*inputs, **equation.params)
                outputs = found if equation.primitive.multiple_results else [found]
            values |= zip(equation.outvars, outputs, strict=True)
        return _lookup(values, jaxpr.outvars)

    def _nodes(self, equation: core.JaxprEqn, inputs: Sequence[Value]) -> Sequence[Value]:
        """Append the nodes of one primitive that depends on the observation, and return its outputs."""
        kind, params = equation.primitive.name, equation.params
        first = inputs[0]
        if kind in _SHAPES_ONLY:
            return [first]
        if kind in _OPERATORS:
            return self.add(_OPERATORS[kind], inputs)
        if kind == "dot_general" and isinstance(first, str) and params["dimension_numbers"] == (((0,), (0,)), ((), ())):
            return self.add("MatMul", inputs)
        if kind == "convert_element_type":
            return self.add("Cast", inputs, to=helper.np_dtype_to_tensor_dtype(np.dtype(params["new_dtype"])))
        if kind == "square":
            return self.add("Mul", [first, first])
        if kind == "integer_pow":
            return self.add("Pow", [first, np.float32(params["y"])])
        if kind == "rsqrt":
            return self.add("Reciprocal", self.add("Sqrt", [first]))
        if kind == "expm1":
            return self.add("Sub", [*self.add("Exp", [first]), np.float32(1.0)])
        if kind == "log1p":
            return self.add("Log", self.add("Add", [first, np.float32(1.0)]))
        if kind == "ne":
            return self.add("Not", self.add("Equal", inputs))
        if kind == "select_n" and len(inputs) == 3:
            return self.add("Where", [first, inputs[2], inputs[1]])
        if kind == "reduce_sum":
            return self.add("ReduceSum", [first, np.array([-1])], keepdims=1)
        if kind == "split":
            return self.add("Split", [first, np.array(params["sizes"])], len(params["sizes"]), axis=-1)
        raise UserError(f"the policy cannot be exported: there is no translation for '{kind}'")


def _lookup(values: Mapping[core.Var, Value], variables: Sequence[core.Var | core.Literal]) -> list[Value]:
    """Values of a jaxpr's variables; a literal holds its own."""
    return [variable.val if isinstance(variable, core.Literal) else values[variable] for variable in variables]
