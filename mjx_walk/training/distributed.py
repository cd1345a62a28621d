"""One run on several devices, one process each: every process acts on its own device, and all learn together.

A program over several devices crashes where it contains Warp's physics (jax 0.11, Warp 1.18). So `collect` is each
process's own program, and `learn`, which holds no physics, one over all devices. In it gradients and running statistics
are means over the devices (`collectives`), so that what is learned is the same on each.
"""

import dataclasses
import functools
import itertools
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from orbax.checkpoint import multihost

from mjx_walk.runs.metrics import is_sum
from mjx_walk.utils import collectives
from mjx_walk.utils.collectives import AXIS
from mjx_walk.utils.types import Algorithm, Metrics, TrainState

OWN = ("env", "noise", "replay", "key", "noise_key")
"""Fields of a TrainState that each device has its own of; the others are alike on all."""

_PATH_BYTES = 4096
_PATIENCE = 3600
"""Seconds that processes wait for each other, of which one may read or write a large replay."""
_waits = itertools.count()


@dataclasses.dataclass(frozen=True)
class Team:
    """The processes of a run, each with one device. TrainStates have an axis of one in front."""

    rank: int
    size: int

    @functools.cached_property
    def _sharding(self) -> NamedSharding:
        devices = sorted(jax.devices(), key=lambda device: device.process_index)
        return NamedSharding(Mesh(np.array(devices), (AXIS,)), PartitionSpec(AXIS))

    def beginning(self, algorithm: Algorithm) -> Algorithm:
        """One whose TrainState has an axis of one in front; what is a device's own begins from a key of its own."""

        def init(key):
            state, own = algorithm.init(key), algorithm.init(jax.random.fold_in(key, self.rank))
            return _expand(state.replace(**{name: getattr(own, name) for name in OWN if hasattr(state, name)}))

        return algorithm._replace(init=init)

    def make_chunk(
        self, algorithm: Algorithm, num_updates: int, reward_terms: tuple[str, ...]
    ) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
        """As `loop.make_chunk`; the metrics are those of all devices."""

        @functools.partial(jax.jit, inline=True)  # traced once, for the sizes and for the program
        def collect(state):
            return _expand(algorithm.collect(_squeeze(state)))

        def learn(state, batch):
            state, metrics = algorithm.learn(_squeeze(state), _squeeze(batch))
            return _expand((state, {name: _over_devices(name, x, reward_terms) for name, x in metrics.items()}))

        mapped = jax.shard_map(
            learn,
            mesh=self._sharding.mesh,
            in_specs=PartitionSpec(AXIS),
            out_specs=PartitionSpec(AXIS),
            check_vma=False,  # Brax's networks and losses know nothing of it
        )
        act, learn_together = in_place(collect), jax.jit(mapped, donate_argnums=0)
        compiled: list[Callable] = []
        batches: list[Any] = []

        def chunk(state):
            if not batches:
                batches.append(jax.tree.map(jnp.zeros_like, jax.eval_shape(collect, state)[1]))
            rows = []
            for _ in range(num_updates):
                state, batch = act(state, batches.pop())
                batches.append(batch)
                shared = jax.tree.map(self._share, (state, batch))
                if not compiled:
                    compiled.append(learn_together.lower(*shared).compile())
                    self.wait()
                state, metrics = jax.tree.map(lambda x: x.addressable_data(0), compiled[0](*shared))
                rows.append(metrics)
            return state, jax.tree.map(lambda *xs: jnp.concatenate(xs), *rows)

        return chunk

    def _share(self, x: jax.Array) -> jax.Array:
        """This process's part of an array over all devices; nothing is copied."""
        return jax.make_array_from_single_device_arrays((self.size, *x.shape[1:]), self._sharding, [x])

    def wait(self) -> None:
        """Until all processes are here. A program over all devices bears to wait for half a minute only, on CPUs."""
        name = f"mjx_walk_{next(_waits)}"
        multihost.sync_global_processes(name, timeout=_PATIENCE, processes=set(range(self.size)))

    def gather(self, number: int) -> list[int]:
        """The numbers of all processes, by rank."""
        self.wait()
        return [int(x) for x in multihost_utils.process_allgather(np.int64(number))]

    def first_ones(self, text: str) -> str:
        """The text that the first process has."""
        self.wait()
        data = np.zeros(_PATH_BYTES, np.uint8)
        encoded = text.encode()[:_PATH_BYTES]
        data[: len(encoded)] = np.frombuffer(encoded, np.uint8)
        return bytes(np.asarray(multihost_utils.broadcast_one_to_all(data))).rstrip(b"\0").decode()


def in_place(collect: Callable[[Any], tuple[Any, Any]]) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Compile `state → (state, batch)` as `(state, batch before) → (state, batch)`, both in the memory of the old ones.

    Where results are in new memory, XLA may keep arrays there that physics reads, and Warp records its kernels anew
    for every array that has moved.
    """
    return jax.jit(lambda state, batch_before: collect(state), donate_argnums=(0, 1), keep_unused=True)


def per_device(config: Any, size: int) -> Any:
    """An algorithm's settings for one of several devices, which counts its own steps only."""
    shares = {
        name: -(-getattr(config, name) // size)
        for name in ("schedule_steps", "learning_starts")
        if hasattr(config, name)
    }
    return dataclasses.replace(config, **shares)


def join() -> Team | None:
    """The team that `launch` or a cluster's scheduler has put this process into, if one has."""
    jax.config.update("jax_enable_preemption_service", False)  # it would take our SIGTERM
    given = os.environ.get("MJX_WALK_TEAM")
    if given:
        rank, size, coordinator = given.split(",")
        jax.distributed.initialize(coordinator, int(size), int(rank))
    elif int(os.environ.get("SLURM_NTASKS", os.environ.get("OMPI_COMM_WORLD_SIZE", "1"))) > 1:
        jax.distributed.initialize()
    if jax.process_count() == 1:
        return None
    return Team(jax.process_index(), jax.process_count())


def _squeeze(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[0], tree)


def _expand(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x)[None], tree)


def _over_devices(name: str, value: jax.Array, reward_terms: tuple[str, ...]) -> jax.Array:
    if is_sum(name, reward_terms):
        return collectives.total(value)
    if name.startswith("eval_"):  # every device's round ends when it ends; the first one's are told
        return jax.lax.all_gather(value, AXIS)[0]
    return collectives.mean(value)
