"""A policy as an ONNX graph, translated from its jaxpr, so that it is the policy that was trained by construction.

jax2onnx would do it, but its releases that run on the versions used here exclude each other with them (Orbax), or give
graphs that onnxruntime refuses.
"""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from mjx_walk.utils.errors import UserError

_OPSET = 17
_SAME = {
    "abs": "Abs",
    "add": "Add",
    "div": "Div",
    "eq": "Equal",
    "erf": "Erf",
    "exp": "Exp",
    "ge": "GreaterOrEqual",
    "gt": "Greater",
    "le": "LessOrEqual",
    "log": "Log",
    "logistic": "Sigmoid",
    "lt": "Less",
    "max": "Max",
    "min": "Min",
    "mul": "Mul",
    "neg": "Neg",
    "not": "Not",
    "pow": "Pow",
    "sign": "Sign",
    "sqrt": "Sqrt",
    "sub": "Sub",
    "tanh": "Tanh",
}
"""JAX's primitives that ONNX has, too."""
_INLINED = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")
_SHAPES_ONLY = ("broadcast_in_dim", "reshape", "squeeze", "expand_dims", "copy", "stop_gradient")


def translate(policy: Callable[[jax.Array], jax.Array], observation_size: int, name: str) -> onnx.ModelProto:
    """Translate a policy.

    Args:
        policy: `[observation_size] f32 → [action_size] f32`, of a vector.
        observation_size: its size.
        name: of the graph.

    Returns:
        A model from `observation`, `[N, observation_size] f64`, to `action`, `[N, action_size] f32`, both Gymnasium's.

    Raises:
        UserError: the policy does something that there is no translation for.
    """
    closed = jax.make_jaxpr(policy)(jnp.zeros(observation_size))
    graph = _Graph()
    obs = graph.add("Cast", ["observation"], to=TensorProto.FLOAT)
    (action,) = graph.follow(closed.jaxpr, closed.consts, [obs])
    graph.nodes.append(helper.make_node("Identity", [graph.name(action)], ["action"]))
    model = helper.make_model(
        helper.make_graph(
            graph.needed_for("action"),
            name,
            [helper.make_tensor_value_info("observation", TensorProto.DOUBLE, ["N", observation_size])],
            [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", closed.out_avals[0].shape[-1]])],
            graph.initializers,
        ),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=8,
        producer_name="mjx_walk",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


class _Graph:
    """ONNX nodes as they come. A value is the name of an output where it depends on the observation, else its array.

    What depends on the observation has no batch axis in the jaxpr, but one in front here: a vector is `[N, size]`, a
    scalar `[N, 1]`. So ONNX's broadcasting does what JAX's changes of shape do.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []
        self._count = itertools.count()

    def add(self, kind: str, inputs: list[Any], num_outputs: int = 1, **attributes: Any) -> Any:
        """A node; its output's name, or a list of names."""
        names = [f"v{next(self._count)}" for _ in range(num_outputs)]
        self.nodes.append(helper.make_node(kind, [self.name(x) for x in inputs], names, **attributes))
        return names[0] if num_outputs == 1 else names

    def name(self, value: Any) -> str:
        """A value's name; an array becomes a part of the model."""
        if isinstance(value, str):
            return value
        self.initializers.append(numpy_helper.from_array(np.asarray(value), f"c{next(self._count)}"))
        return self.initializers[-1].name

    def needed_for(self, output: str) -> list[onnx.NodeProto]:
        """The nodes that an output depends on, in order; the arrays that no other node needs are dropped."""
        wanted, kept = {output}, []
        for node in reversed(self.nodes):
            if wanted.intersection(node.output):
                wanted.update(node.input)
                kept.append(node)
        self.initializers = [array for array in self.initializers if array.name in wanted]
        return kept[::-1]

    def follow(self, jaxpr: Any, consts: list[Any], arguments: list[Any]) -> list[Any]:
        """Translate a jaxpr; its outputs."""
        values: dict[Any, Any] = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *arguments), strict=True))

        def read(variable: Any) -> Any:
            return variable.val if hasattr(variable, "val") else values[variable]

        for equation in jaxpr.eqns:
            inputs = [read(variable) for variable in equation.invars]
            if equation.primitive.name in _INLINED:
                inner = next(equation.params[key] for key in ("jaxpr", "call_jaxpr") if key in equation.params)
                outputs = self.follow(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), inputs)
            elif not any(isinstance(value, str) for value in inputs):
                found = equation.primitive.bind(*inputs, **equation.params)
                outputs = found if equation.primitive.multiple_results else [found]
            else:
                found = self._node(equation, inputs)
                outputs = found if isinstance(found, list) else [found]
            values |= zip(equation.outvars, outputs, strict=True)
        return [read(variable) for variable in jaxpr.outvars]

    def _node(self, equation: Any, inputs: list[Any]) -> Any:
        """The nodes of one primitive that depends on the observation."""
        kind, params = equation.primitive.name, equation.params
        first = inputs[0]
        if kind in _SHAPES_ONLY:
            return first
        if kind in _SAME:
            return self.add(_SAME[kind], inputs)
        if kind == "dot_general" and isinstance(first, str) and params["dimension_numbers"] == (((0,), (0,)), ((), ())):
            return self.add("MatMul", inputs)
        if kind == "convert_element_type":
            return self.add("Cast", inputs, to=helper.np_dtype_to_tensor_dtype(np.dtype(params["new_dtype"])))
        if kind == "square":
            return self.add("Mul", [first, first])
        if kind == "integer_pow":
            return self.add("Pow", [first, np.float32(params["y"])])
        if kind == "rsqrt":
            return self.add("Reciprocal", [self.add("Sqrt", [first])])
        if kind == "expm1":
            return self.add("Sub", [self.add("Exp", [first]), np.float32(1.0)])
        if kind == "log1p":
            return self.add("Log", [self.add("Add", [first, np.float32(1.0)])])
        if kind == "ne":
            return self.add("Not", [self.add("Equal", inputs)])
        if kind == "select_n" and len(inputs) == 3:
            return self.add("Where", [first, inputs[2], inputs[1]])
        if kind == "reduce_sum":
            return self.add("ReduceSum", [first, np.array([-1])], keepdims=1)
        if kind == "split":
            return self.add("Split", [first, np.array(params["sizes"])], len(params["sizes"]), axis=-1)
        raise UserError(f"the policy cannot be exported: there is no translation for '{kind}'")
