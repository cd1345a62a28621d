"""One run on several devices, one process each: every process collects on its device, and all learn together.

A program over several devices crashes where it contains Warp's physics (jax 0.11, Warp 1.18). So `collect` is a local
program of each process, and `learn`, which contains no physics, is one program over all devices. It averages gradients
and running statistics over the devices, so that what is learned is the same on each.
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

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.training.programs import Program, Step, make_axis_program, make_init
from mjx_walk.utils import collectives
from mjx_walk.utils.collectives import DEVICES
from mjx_walk.utils.types import Metric, Metrics, Reduction, map_marked

_PATH_BYTES = 4096
_TIMEOUT = 3600
"""Seconds that processes wait for each other, of which one may read or write a large replay."""
_barriers = itertools.count()


@dataclasses.dataclass(frozen=True)
class Processes:
    """The processes of a run, with one device each."""

    process_index: int = 0
    process_count: int = 1

    @property
    def is_main_process(self) -> bool:
        """Whether this process writes the run folder."""
        return self.process_index == 0

    def wait_for_all(self) -> None:
        """Wait until all processes are here. On CPUs, a program over all devices waits for half a minute only."""
        if self.process_count > 1:
            name, processes = f"mjx_walk_{next(_barriers)}", set(range(self.process_count))
            multihost.sync_global_processes(name, timeout=_TIMEOUT, processes=processes)

    def all_gather(self, number: int) -> list[int]:
        """The numbers of all processes, by process index."""
        if self.process_count == 1:
            return [number]
        self.wait_for_all()
        return [int(x) for x in multihost_utils.process_allgather(np.int64(number))]

    def broadcast_one_to_all(self, text: str) -> str:
        """The text of the main process."""
        if self.process_count == 1:
            return text
        self.wait_for_all()
        data = np.zeros(_PATH_BYTES, np.uint8)
        encoded = text.encode()[:_PATH_BYTES]
        data[: len(encoded)] = np.frombuffer(encoded, np.uint8)
        return bytes(np.asarray(multihost_utils.broadcast_one_to_all(data))).rstrip(b"\0").decode()


def join_processes() -> Processes:
    """The processes that `launcher` or a cluster's scheduler has started with this one."""
    jax.config.update("jax_enable_preemption_service", False)  # it would take our SIGTERM
    given = os.environ.get("MJX_WALK_PROCESS")
    if given:
        index, count, coordinator = given.split(",")
        jax.distributed.initialize(coordinator, int(count), int(index))
    elif int(os.environ.get("SLURM_NTASKS", os.environ.get("OMPI_COMM_WORLD_SIZE", "1"))) > 1:
        jax.distributed.initialize()
    return Processes(jax.process_index(), jax.process_count())


def per_device(config: Any, process_count: int) -> Any:
    """The settings of an algorithm on one of several devices, which counts its own steps only."""
    if process_count == 1:
        return config
    names = {field.name for field in dataclasses.fields(config)} & {"schedule_steps", "learning_starts"}
    return dataclasses.replace(config, **{name: -(-getattr(config, name) // process_count) for name in names})


def make_devices_program(algorithm: Algorithm, processes: Processes, iterations_per_call: int) -> Program:
    """One run on the devices of all processes. States have an axis of length one in front.

    Args:
        algorithm: with the axis name `DEVICES`.
        processes: of the run.
        iterations_per_call: iterations of a call.
    """
    init = make_init(functools.partial(_init_on_device, algorithm, processes.process_index))
    return make_axis_program(
        algorithm,
        1,
        init=lambda keys: init(keys[0]),
        step=_make_step(algorithm, processes, iterations_per_call),
        split_metrics=lambda metrics: [jax.device_get(metrics)],
        max_over_processes=lambda number: max(processes.all_gather(number)),
    )


def _init_on_device(algorithm: Algorithm, process_index: int, key: jax.Array) -> TrainState:
    """The state of a device. Leaves that each device has its own of start from a key of its own."""
    shared, own = algorithm.init(key), algorithm.init(jax.random.fold_in(key, process_index))
    return _expand(map_marked(lambda _, leaf: leaf, "per_device", shared, own))


def _make_step(algorithm: Algorithm, processes: Processes, iterations_per_call: int) -> Step:
    """As `programs.make_step`; the metrics are those of all devices."""
    devices = sorted(jax.devices(), key=lambda device: device.process_index)
    sharding = NamedSharding(Mesh(np.array(devices), (DEVICES,)), PartitionSpec(DEVICES))

    @functools.partial(jax.jit, inline=True)  # traced once, for the sizes and for the program
    def collect(state):
        return _expand(algorithm.collect(_squeeze(state)))

    def learn(state, batch):
        state, metrics = algorithm.learn(_squeeze(state), _squeeze(batch))
        return _expand((state, {name: _over_devices(metric) for name, metric in metrics.items()}))

    def share(x: jax.Array) -> jax.Array:
        """This process's part of an array over all devices; nothing is copied."""
        shape = (processes.process_count, *x.shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, [x])

    mapped = jax.shard_map(
        learn,
        mesh=sharding.mesh,
        in_specs=PartitionSpec(DEVICES),
        out_specs=PartitionSpec(DEVICES),
        check_vma=False,  # Brax's networks and losses do not annotate it
    )
    collect_in_place, learn_together = in_place(collect), jax.jit(mapped, donate_argnums=0)
    compiled: list[Callable] = []
    batches: list[Any] = []

    def step(state: TrainState) -> tuple[TrainState, Metrics]:
        if not batches:
            batches.append(jax.tree.map(jnp.zeros_like, jax.eval_shape(collect, state)[1]))
        rows = []
        for _ in range(iterations_per_call):
            state, batch = collect_in_place(state, batches.pop())
            batches.append(batch)
            shared = jax.tree.map(share, (state, batch))
            if not compiled:
                compiled.append(learn_together.lower(*shared).compile())
                processes.wait_for_all()
            state, metrics = jax.tree.map(lambda x: x.addressable_data(0), compiled[0](*shared))
            rows.append(metrics)
        return state, jax.tree.map(lambda *xs: jnp.concatenate(xs), *rows)

    return step


def in_place(collect: Callable[[Any], tuple[Any, Any]]) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Compile `state → (state, batch)` as `(state, former batch) → (state, batch)`, in the memory of its arguments.

    In new memory, XLA may place arrays that physics reads, and Warp records its kernels again for every array that has
    moved.
    """
    return jax.jit(lambda state, former_batch: collect(state), donate_argnums=(0, 1), keep_unused=True)


def _over_devices(metric: Metric) -> Metric:
    value = metric.value
    if metric.reduction in (Reduction.SUM, Reduction.PER_EPISODE):
        value = collectives.total(value, DEVICES)
    elif metric.reduction is Reduction.FIRST_DEVICE:
        value = jax.lax.all_gather(value, DEVICES)[0]
    else:
        value = collectives.mean(value, DEVICES)
    return Metric(value, metric.reduction)


def _squeeze(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[0], tree)


def _expand(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x)[None], tree)
