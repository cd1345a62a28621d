"""Hydra with a state of our own, which a program that uses Hydra itself never sees."""

import contextlib
import copy
import threading
from collections import UserDict
from collections.abc import Iterator
from typing import Any, TypeVar

from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.version import VersionBase
from omegaconf.basecontainer import BaseContainer

from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.settings.schema import Config

__all__ = ["own_hydra"]

_lock = threading.RLock()
_STATE = (ConfigStore, GlobalHydra, HydraConfig, JobRuntime, VersionBase)
"""Hydra's singletons that a program changes."""
_own: dict[type, Any] = {}
"""This package's `ConfigStore`, once it is made."""
_registered: dict[tuple[str | None, str], type] = {}
"""Nodes by group and name."""


@contextlib.contextmanager
def own_hydra() -> Iterator[ConfigStore]:
    """Context manager in which Hydra has a fresh state, and a store with the schema and the groups `env` and `algo`.

    Hydra's singletons and OmegaConf's resolvers differ in this thread only. On exit they are those from before. Other
    threads wait at its entry.

    Yields:
        The store.
    """
    with _lock:
        Plugins.instance()  # plugins are imported once, and add to the store that is in use
        hydras_nodes = ConfigStore.instance().repo["hydra"]
        # `Singleton.get_state` would copy the objects, and the program may hold references to them.
        instances, resolvers = Singleton._instances, BaseContainer._resolvers
        ours = {kind: one for kind, one in instances.items() if kind not in _STATE} | _own
        seen_instances, seen_resolvers = _OwnInOneThread(instances, ours), _OwnInOneThread(resolvers, dict(resolvers))
        try:
            Singleton._instances, BaseContainer._resolvers = seen_instances, seen_resolvers  # type: ignore[assignment]
            store = _own[ConfigStore] = ConfigStore.instance()
            store.repo["hydra"] = hydras_nodes
            _register_schemas(store)
            yield store
        finally:
            # Another thread may have replaced them, as `OmegaConf.clear_resolvers` does.
            if Singleton._instances is seen_instances:
                Singleton._instances = instances
            if BaseContainer._resolvers is seen_resolvers:
                BaseContainer._resolvers = resolvers


_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class _OwnInOneThread(UserDict[_Key, _Value]):
    """A dictionary that is another one in the thread that makes it."""

    def __init__(self, everyones: dict[_Key, _Value], own: dict[_Key, _Value]):
        self._everyones, self._own, self._owner = everyones, own, threading.get_ident()

    @property
    def data(self) -> dict[_Key, _Value]:  # type: ignore[override]
        return self._own if threading.get_ident() == self._owner else self._everyones

    def __deepcopy__(self, memo: dict[int, object]) -> dict[_Key, _Value]:
        return copy.deepcopy(self.data, memo)


def _register_schemas(store: ConfigStore) -> None:
    nodes: dict[tuple[str | None, str], type] = {(None, "schema"): Config}
    nodes |= {("env", name): options for name, (_, options) in TASKS.items()}
    nodes |= {("algo", name): settings for name, (_, settings) in ALGORITHMS.items()}
    for (group, name), node in nodes.items():
        if _registered.get((group, name)) is not node:  # Hydra takes a millisecond for each
            store.store(group=group, name=name, node=node)
            _registered[group, name] = node
