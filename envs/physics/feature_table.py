"""Tables of features of a model that some engines do not simulate, and the names of the elements that use them."""

import functools
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeVar

import mujoco
import numpy as np
from jaxtyping import Shaped

__all__ = ["EVERY_ENGINE", "Feature", "FeatureTable", "Mask", "any_of", "name_of"]

EVERY_ENGINE = ("warp", "jax", "c")
_SPOKEN = {"actuator": "motor", "eq": "equality constraint", "pair": "contact pair"}

Mask = Shaped[np.ndarray, " n"]
"""Elements of one kind that use a feature."""
_Find = TypeVar("_Find", bound=Callable[[mujoco.MjModel], Mask | Iterable[str]])


class Feature(NamedTuple):
    """A feature of a model that some engines do not simulate."""

    engines: tuple[str, ...]
    """The engines that do not simulate it."""
    kind: str | None
    """Kind of the elements that use it, such as `joint`."""
    what: str
    """The feature, as the subject of a sentence."""
    advice: str
    """Change of the model that makes it acceptable."""
    find: Callable[[mujoco.MjModel], Mask | Iterable[str]]
    """Marks the elements of that kind that use it. Without a kind, gives their names."""

    def users(self, model: mujoco.MjModel) -> Iterator[str]:
        """The elements of a model that use the feature, as `kind 'name'`."""
        found = self.find(model)
        if isinstance(found, np.ndarray):
            assert self.kind is not None
            found = [name_of(model, self.kind, int(i)) for i in np.flatnonzero(found)]
        yield from found


class FeatureTable(list[Feature]):
    """Features in the order in which a model is checked for them."""

    def entry(self, engines: tuple[str, ...], kind: str | None, what: str, advice: str) -> Callable[[_Find], _Find]:
        """Decorator that enters a function as `find` of a feature; see `Feature`."""
        return functools.partial(self._enter, engines, kind, what, advice)

    def _enter(self, engines: tuple[str, ...], kind: str | None, what: str, advice: str, find: _Find) -> _Find:
        self.append(Feature(engines, kind, what, advice, find))
        return find


def name_of(model: mujoco.MjModel, kind: str, index: int) -> str:
    """An element as `kind 'name'`, or with its index if it has no name."""
    name = getattr(model, kind)(index).name
    return f"{_SPOKEN.get(kind, kind)} '{name}'" if name else f"{_SPOKEN.get(kind, kind)} {index}"


def any_of(*arrays: Shaped[np.ndarray, "n ..."]) -> Mask:
    """For each element, whether any value of any array is not zero."""
    return np.array([any(np.any(row) for row in rows) for rows in zip(*arrays, strict=True)], bool)
