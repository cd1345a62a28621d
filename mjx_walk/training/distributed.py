"""One run on several devices with one process each. Each process collects on its device, and all learn together.

A program over several devices crashes if it contains Warp's physics (jax 0.11, Warp 1.18). `collect` is therefore a
local program of each process. `learn` contains no physics and is one program over all devices. It averages gradients
and running statistics, so that the learned parameters are equal on all devices.
"""

import dataclasses
import functools
import itertools
import os
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from orbax.checkpoint import multihost

from mjx_walk.algos import Algorithm, AlgorithmConfig, TrainState
from mjx_walk.utils import collectives
from mjx_walk.utils.collectives import DEVICES
from mjx_walk.utils.setting_fields import Dataclass
from mjx_walk.utils.types import Metric, Metrics, PyTree, Reduction, map_leaves_with

__all__ = ["DevicesStep", "Processes", "in_place", "init_on_device", "join_processes", "per_device"]

_PATH_BYTES = 4096
_TIMEOUT = 3600
"""Seconds that processes wait for each other. One of them may read or write a large replay buffer."""
_barriers = itertools.count()

_StateT = TypeVar("_StateT", bound=TrainState)
_BatchT = TypeVar("_BatchT")
_ConfigT = TypeVar("_ConfigT", bound=AlgorithmConfig)
_Settings = TypeVar("_Settings", bound=Dataclass)
_Tree = TypeVar("_Tree")


@dataclasses.dataclass(frozen=True)
class Processes:
    """Processes of a run, with one device each."""

    process_index: int = 0
    process_count: int = 1

    @property
    def is_main_process(self) -> bool:
        """Whether this process writes the run folder."""
        return self.process_index == 0

    @property
    def axis_name(self) -> str | None:
        """Name of the mapped axis over the devices in `Algorithm.learn`. None for one device."""
        return DEVICES if self.process_count > 1 else None

    def wait_for_all(self) -> None:
        """Wait until all processes reach this call. On CPUs, a program over all devices waits only half a minute."""
        if self.process_count > 1:
            name, processes = f"mjx_walk_{next(_barriers)}", set(range(self.process_count))
            multihost.sync_global_processes(name, timeout=_TIMEOUT, processes=processes)

    def all_gather(self, number: int) -> list[int]:
        """Numbers of all processes, by process index."""
        if self.process_count == 1:
            return [number]
        self.wait_for_all()
        return [int(x) for x in multihost_utils.process_allgather(np.int64(number))]

    def broadcast_one_to_all(self, text: str) -> str:
        """Text of the main process."""
        if self.process_count == 1:
            return text
        self.wait_for_all()
        data = np.zeros(_PATH_BYTES, np.uint8)
        encoded = text.encode()[:_PATH_BYTES]
        data[: len(encoded)] = np.frombuffer(encoded, np.uint8)
        return bytes(np.asarray(multihost_utils.broadcast_one_to_all(data))).rstrip(b"\0").decode()


def join_processes() -> Processes:
    """Join the processes that `launcher` or a cluster's scheduler has started."""
    jax.config.update("jax_enable_preemption_service", False)  # its handler would replace ours for SIGTERM
    given = os.environ.get("MJX_WALK_PROCESS")
    if given:
        index, count, coordinator = given.split(",")
        jax.distributed.initialize(coordinator, int(count), int(index))
    elif int(os.environ.get("SLURM_NTASKS", os.environ.get("OMPI_COMM_WORLD_SIZE", "1"))) > 1:
        jax.distributed.initialize()
    return Processes(jax.process_index(), jax.process_count())


def per_device(config: _Settings, process_count: int) -> _Settings:
    """Settings of an algorithm or of the evaluation for one of several devices, which counts only its own steps."""
    if process_count == 1:
        return config
    counts = {"schedule_steps", "learning_starts", "every_steps"}
    names = {field.name for field in dataclasses.fields(config)} & counts
    return dataclasses.replace(config, **{name: -(-getattr(config, name) // process_count) for name in names})


def init_on_device(algorithm: Algorithm, process_index: int, key: jax.Array) -> TrainState:
    """Initial state of a device. Leaves that are per device start from the device's own key."""
    shared, own = algorithm.init(key), algorithm.init(jax.random.fold_in(key, process_index))
    state = map_leaves_with(lambda _, leaf: leaf, "per_device", shared, own)
    # The devices act with the shared policy, so that is the one that their first evaluation scores.
    policies = {"policy_params": algorithm.policy_params(shared), "best_policy_params": algorithm.policy_params(shared)}
    return _expand(state.replace(evaluation=state.evaluation.replace(**policies)))


class DevicesStep:
    """Several iterations on the devices of all processes: `state → (state, metrics)`, with metrics over all devices.

    The results of an iteration take the memory of the one before, so that the arrays of physics do not move.
    """

    def __init__(self, algorithm: Algorithm, iterations_per_call: int, processes: Processes):
        """
        Args:
            algorithm: algorithm with the axis name `DEVICES`.
            iterations_per_call: iterations of a call.
            processes: processes of the run.
        """
        self._iterations_per_call = iterations_per_call
        self._processes = processes
        devices = sorted(jax.devices(), key=lambda device: device.process_index)
        self._sharding = NamedSharding(Mesh(np.array(devices), (DEVICES,)), PartitionSpec(DEVICES))
        # Inline programs are traced once for both their shapes and the program around them.
        self._collect = jax.jit(functools.partial(_collect, algorithm), inline=True)
        self._collect_in_place = in_place(self._collect)
        self._learn = jax.jit(_over_all_devices(functools.partial(_learn, algorithm), self._sharding), inline=True)
        self._learn_and_log = jax.jit(
            functools.partial(_learn_and_log, self._learn), donate_argnums=(0, 2), out_shardings=self._sharding
        )
        self._compiled: jax.stages.Compiled | None = None
        self._row_shapes: Metrics = {}
        self._batch: PyTree = None
        """The last batch, in whose memory the next one is collected."""

    def __call__(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """One call."""
        if self._batch is None:
            self._batch = jax.tree.map(jnp.zeros_like, jax.eval_shape(self._collect, state)[1])
        rows: Metrics = {}
        for index in range(self._iterations_per_call):
            state, self._batch = self._collect_in_place(state, self._batch)
            state, rows = self._learn_from(state, self._batch, rows, index)
        return state, rows

    def _learn_from(self, state: TrainState, batch: PyTree, rows: Metrics, index: int) -> tuple[TrainState, Metrics]:
        """Learn from the batches of all devices, and write the metrics at an index of the rows."""
        shared = jax.tree.map(self._share, (state, batch))
        if not self._row_shapes:
            self._row_shapes = jax.eval_shape(self._learn, *shared)[1]
        if not rows:
            rows = jax.tree.map(lambda x: jnp.zeros((1, self._iterations_per_call), x.dtype), self._row_shapes)
        arguments = (*shared, jax.tree.map(self._share, rows), np.int32(index))
        if self._compiled is None:
            self._compiled = self._learn_and_log.lower(*arguments).compile()
            self._processes.wait_for_all()
        return jax.tree.map(lambda x: x.addressable_data(0), self._compiled(*arguments))

    def _share(self, x: jax.Array) -> jax.Array:
        """Array over all devices with this process's part in place. Copies nothing."""
        shape = (self._processes.process_count, *x.shape[1:])
        return jax.make_array_from_single_device_arrays(shape, self._sharding, [x])


def _collect(algorithm: Algorithm[_StateT, _BatchT, _ConfigT], state: _StateT) -> tuple[_StateT, _BatchT]:
    return _expand(algorithm.collect(_squeeze(state)))


def _learn(algorithm: Algorithm[_StateT, _BatchT, _ConfigT], state: _StateT, batch: _BatchT) -> tuple[_StateT, Metrics]:
    """Learn on one device, with metrics over all of them."""
    state, metrics = algorithm.learn(_squeeze(state), _squeeze(batch))
    return _expand((state, {name: _over_devices(metric) for name, metric in metrics.items()}))


def _learn_and_log(
    learn: Callable[[_StateT, _BatchT], tuple[_StateT, Metrics]],
    state: _StateT,
    batch: _BatchT,
    rows: Metrics,
    index: jax.Array,
) -> tuple[_StateT, Metrics]:
    state, metrics = learn(state, batch)
    return state, jax.tree.map(lambda row, x: row.at[:, index].set(x), rows, metrics)


def _over_all_devices(function: Callable, sharding: NamedSharding) -> Callable:
    """Map a function over the axis of devices in front of its arguments and results."""
    return jax.shard_map(
        function,
        mesh=sharding.mesh,
        in_specs=PartitionSpec(DEVICES),
        out_specs=PartitionSpec(DEVICES),
        check_vma=False,  # Brax's networks and losses do not annotate it
    )


def in_place(
    collect: Callable[[_StateT], tuple[_StateT, _BatchT]],
) -> Callable[[_StateT, _BatchT], tuple[_StateT, _BatchT]]:
    """Compile `state → (state, batch)` as `(state, former batch) → (state, batch)`, in the memory of its arguments.

    With new memory, XLA may move arrays that physics reads. Warp records its kernels again when an array moves.
    """
    return jax.jit(lambda state, former_batch: collect(state), donate_argnums=(0, 1), keep_unused=True)


def _over_devices(metric: Metric) -> Metric:
    """A metric of all devices. Either all of them have a mean in an iteration, or none."""
    if metric.reduction in (Reduction.SUM, Reduction.PER_EPISODE):
        return metric.replace(value=collectives.total(metric.value, DEVICES))
    if metric.reduction is Reduction.FIRST_DEVICE:
        return jax.tree.map(lambda x: jax.lax.all_gather(x, DEVICES)[0], metric)
    return metric.replace(value=collectives.mean(metric.value, DEVICES))


def _squeeze(tree: _Tree) -> _Tree:
    return jax.tree.map(lambda x: x[0], tree)


def _expand(tree: _Tree) -> _Tree:
    return jax.tree.map(lambda x: jnp.asarray(x)[None], tree)
