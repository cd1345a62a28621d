"""Types that every part of the trainer exchanges, and the metadata of its state's fields."""

import dataclasses
import enum
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, TypeVar

import flax
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.types import Transition
from jax import Array
from jaxtyping import Float, PRNGKeyArray

__all__ = [
    "ITERATION_COUNT",
    "PER_DEVICE",
    "RANDOM_KEY",
    "REPLAY",
    "RESTARTS",
    "Act",
    "Losses",
    "Metric",
    "Metrics",
    "Params",
    "PolicyFn",
    "PolicyParams",
    "PyTree",
    "Reduction",
    "Transition",
    "as_means",
    "leaves_with",
    "map_leaves_with",
]

PyTree: TypeAlias = Any
"""A JAX pytree of any structure, of arrays or of their shapes."""

Params: TypeAlias = Mapping[str, PyTree]
"""Parameters of a network: nested dictionaries of arrays."""

PolicyParams: TypeAlias = tuple[RunningStatisticsState, Params]
"""Observation normalizer and parameters of the policy. Saved policies name their arrays after this structure."""

PolicyFn = Callable[[Float[Array, "B observation_size"], PRNGKeyArray], Float[Array, "B action_size"]]
"""`(obs, key) → action`, in Gymnasium's units on both sides."""

Act = Callable[[Float[Array | np.ndarray, "*batch observation_size"]], Float[Array, "*batch action_size"]]
"""`obs → action` of a deterministic policy, in Gymnasium's units, for one environment or a batch."""

_Tree = TypeVar("_Tree")


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
    """A number that is logged."""

    value: jax.Array
    """`[] f32` of one iteration, `[iterations] f32` of several."""
    reduction: Reduction = flax.struct.field(pytree_node=False)
    has_value: jax.Array | None = None
    """Whether an iteration has a value, a bool in the shape of `value`; None if every iteration has one.

    NaN does not stand for a missing value, because `JAX_DEBUG_NANS=1` stops at every NaN."""

    def only_if(self, condition: Array) -> "Metric":
        """The metric with a value only where a condition, `[] bool`, holds too."""
        has_value = condition if self.has_value is None else condition & self.has_value
        return self.replace(value=jnp.where(has_value, self.value, 0.0), has_value=has_value)


Metrics = dict[str, Metric]
"""Metrics by the names under which they are logged."""


Losses = dict[str, Float[Array, ""]]
"""Losses and other numbers of one update, by the names of their metrics."""


def as_means(values: Losses) -> Metrics:
    """Metrics that are means over iterations."""
    return {name: Metric(value, Reduction.MEAN) for name, value in values.items()}


PER_DEVICE = {"per_device": True}
"""Metadata of a state's field: each device holds its own leaves."""
REPLAY = PER_DEVICE | {"replay": True}
"""Each device holds its own, and only the newest checkpoint keeps it."""
RANDOM_KEY = PER_DEVICE | {"random_key": True}
"""Each device holds its own; a device that joins a run folds its index into it."""
RESTARTS = {"restarts": True}
"""A training that begins with another one's networks starts it anew."""
ITERATION_COUNT = RESTARTS | {"iteration_count": True}
"""A count of iterations, whose environment steps depend on the number of devices."""


def leaves_with(tree: PyTree, key: str) -> list[bool]:
    """For each leaf of a pytree, in order: whether its field, or a field around it, has metadata of this key."""
    flags: list[bool] = []
    for node in jax.tree.leaves(tree, is_leaf=dataclasses.is_dataclass):
        if not dataclasses.is_dataclass(node):
            flags.append(False)
            continue
        for field in dataclasses.fields(node):
            if field.metadata.get("pytree_node", True):
                value = getattr(node, field.name)
                has_key = field.metadata.get(key, False)
                flags += [True] * len(jax.tree.leaves(value)) if has_key else leaves_with(value, key)
    return flags


def map_leaves_with(function: Callable[..., object], key: str, tree: _Tree, *others: PyTree) -> _Tree:
    """Apply a function to the leaves whose field has metadata of this key. Others are those of the first tree."""
    leaves, structure = jax.tree.flatten(tree)
    columns = zip(leaves, *map(jax.tree.leaves, others), strict=True)
    flags = leaves_with(tree, key)
    new = [function(*column) if flag else column[0] for flag, column in zip(flags, columns, strict=True)]
    return jax.tree.unflatten(structure, new)
