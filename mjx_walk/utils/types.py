"""Types that every part of the trainer exchanges, and the marks on the leaves of its state."""

import dataclasses
import enum
from collections.abc import Callable
from typing import Any

import flax
import jax
from brax.training.types import Transition

__all__ = [
    "ITERATION_COUNT",
    "PER_DEVICE",
    "RANDOM_KEY",
    "REPLAY",
    "Metric",
    "Metrics",
    "PolicyFn",
    "Reduction",
    "Transition",
    "as_means",
    "has_mark",
]

PolicyFn = Callable[[jax.Array, jax.Array], jax.Array]
"""`(obs [B, observation_size], key) → action [B, action_size]`, in Gymnasium's units on both sides."""


class Reduction(enum.Enum):
    """How the values of a metric become one, over iterations and over devices."""

    SUM = "sum"
    """A count: summed over both."""
    PER_EPISODE = "per_episode"
    """A sum over finished episodes: summed over both, then divided by the number of episodes."""
    MEAN = "mean"
    """A mean over those iterations that have a value, and over devices."""
    FIRST_DEVICE = "first_device"
    """The value of the first device, in the last iteration that has one."""


class Metric(flax.struct.PyTreeNode):
    """A number that is logged. NaN stands for an iteration without a value."""

    value: jax.Array
    """`[] f32` of one iteration, `[iterations] f32` of several."""
    reduction: Reduction = flax.struct.field(pytree_node=False)


Metrics = dict[str, Metric]
"""Metrics by the names under which they are logged."""


def as_means(values: dict[str, jax.Array]) -> Metrics:
    """Metrics that are means over iterations."""
    return {name: Metric(value, Reduction.MEAN) for name, value in values.items()}


PER_DEVICE = {"per_device": True}
"""Metadata of a state's field: each device holds its own leaves."""
REPLAY = PER_DEVICE | {"replay": True}
"""Each device holds its own, and only the newest checkpoint keeps it."""
RANDOM_KEY = PER_DEVICE | {"random_key": True}
"""Each device holds its own; a device that joins a run folds its index into it."""
ITERATION_COUNT = {"iteration_count": True}
"""A count of iterations, whose environment steps depend on the number of devices."""


def has_mark(tree: Any, mark: str) -> Any:
    """A pytree of bools, one for each leaf: whether its field, or one around it, has the mark."""

    def of_node(node: Any) -> Any:
        if not dataclasses.is_dataclass(node):
            return False
        found = {}
        for field in dataclasses.fields(node):
            if field.metadata.get("pytree_node", True):
                value = getattr(node, field.name)
                is_marked = field.metadata.get(mark, False)
                found[field.name] = jax.tree.map(lambda _: True, value) if is_marked else has_mark(value, mark)
        return dataclasses.replace(node, **found)  # type: ignore[type-var]

    return jax.tree.map(of_node, tree, is_leaf=dataclasses.is_dataclass)
