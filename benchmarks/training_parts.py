"""`python benchmarks/training_parts.py env=humanoid`: speeds of training's parts, next to Gymnasium's.

Collecting and learning stand next to what physics and matrix products alone would take.
"""

import dataclasses
import functools
import resource
import sys
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
from gymnasium.utils.performance import benchmark_step
from program_costs import learning_flops, reduced_bytes

from mjx_walk.algos import Algorithm, TrainState, make_algorithm
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.api import resolve
from mjx_walk.bench import describe_device, show, write
from mjx_walk.cli import parsing
from mjx_walk.common.replay_buffer import ReplayBuffer, Steps
from mjx_walk.envs import Task, require_model
from mjx_walk.envs.physics import make_engine
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.experiments.timing import Measurement
from mjx_walk.machine.devices import default_device
from mjx_walk.settings.config import Config
from mjx_walk.settings.overrides import key_of_value
from mjx_walk.storage.files import user_path
from mjx_walk.training.programs import make_init, make_step
from mjx_walk.utils.collectives import DEVICES
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import Metrics, PyTree, as_means
from mjx_walk.viewing.episode import make_gymnasium

__all__ = ["USAGE", "Arguments", "main", "matmul_speed", "measure", "time_parts"]

USAGE = """
usage: python benchmarks/training_parts.py [env=humanoid] [algo=ppo] [KEY=VALUE ...] [seconds=5] [out=parts.json]

  KEY=VALUE  as for train: physics=jax num_envs=2048 algo.num_epochs=4; by default the recipe for this hardware
  seconds    least time to measure each speed
  out        write the table as JSON, with package versions
"""

_STEPS_PER_CALL = 25
"""About as long as a random policy keeps a humanoid upright. Every call starts from resets, like real episodes."""


@dataclasses.dataclass
class Arguments:
    """Arguments that are not settings of the training."""

    seconds: float = setting(5.0, above=0)
    out: str | None = None


def main(command_line: list[str]) -> None:
    """Measure, print a table, and write JSON if asked."""
    arguments, overrides = parsing.parse_own(Arguments, Config, command_line, USAGE, key_of_value)
    config = resolve(overrides)
    jax.config.update("jax_default_matmul_precision", config.matmul_precision)
    if arguments.out:
        parsing.check_writable(user_path(arguments.out))
    task = require_model(make_task(config))
    device = describe_device(task, config)
    print(f"{task.gymnasium_id} on {device}", flush=True)
    results = show(measure(config, task, arguments.seconds))
    if arguments.out:
        write(arguments.out, task.gymnasium_id, device, results)


def measure(config: Config, task: Task, seconds: float) -> Iterator[Measurement]:
    """Measure environments, training and its parts, and memory.

    Args:
        config: of the training.
        task: its environment.
        seconds: least time to measure each speed.
    """
    on_one_core = benchmark_step(make_gymnasium(task), seconds, seed=0)  # type: ignore[arg-type]
    yield Measurement("Gymnasium, one core", on_one_core, "env-steps/s")
    start = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.PRNGKey(0), config.num_envs))
    engine = make_engine(task.engine.name, task.model, task.options.frame_skip, ())  # without derived arrays
    physics = _random_action_speed(task, start.physics, lambda *args: engine.step(*args)[0], seconds)
    yield Measurement("physics only", physics, "env-steps/s")
    steps = _random_action_speed(task, start, task.step, seconds)
    yield Measurement("physics, observation and reward", steps, "env-steps/s")
    algorithm, fused = _learning_at_once(config, task), not task.engine.calls_host
    call = make_step(algorithm.collect, algorithm.learn, config.iterations_per_call, fused)
    call_seconds = _seconds_per_call(lambda state: call(state)[0], _init(algorithm), seconds)[1]
    training = algorithm.steps_per_iteration * config.iterations_per_call / call_seconds
    yield Measurement("training", training, "env-steps/s")
    yield Measurement("training / Gymnasium on one core", training / on_one_core, "times")
    yield from _iteration_times(config, algorithm, fused, physics, seconds)
    yield Measurement("data to reduce in an iteration, per device", _reduced_bytes(config, task) / 1e6, "MB")
    yield from _peak_memory()
    if isinstance(config.algo, OffPolicyConfig):
        yield from _insert_times(task)


_Carry = TypeVar("_Carry")


def _seconds_per_call(advance: Callable[[_Carry], _Carry], carry: _Carry, seconds: float) -> tuple[_Carry, float]:
    """The carry after repeated calls of `carry → carry`, and seconds per call without the first one, which compiles."""
    carry = jax.block_until_ready(advance(carry))
    start, calls = time.monotonic(), 0
    while time.monotonic() - start < seconds:
        carry = jax.block_until_ready(advance(carry))
        calls += 1
    return carry, (time.monotonic() - start) / calls


def _random_action_speed(
    task: Task, start: PyTree, step: Callable[[PyTree, jax.Array], PyTree], seconds: float
) -> float:
    """Environment steps per second of `step`, under random actions from a batch of starts."""
    advance = jax.jit(functools.partial(_advance, task, start, jax.vmap(step)))
    num_steps = len(jax.tree.leaves(start)[0]) * _STEPS_PER_CALL
    return num_steps / _seconds_per_call(advance, jax.random.PRNGKey(1), seconds)[1]


def _advance(task: Task, start: PyTree, step: Callable[[PyTree, jax.Array], PyTree], key: jax.Array) -> jax.Array:
    """Take random actions for `_STEPS_PER_CALL` steps from the start, and return the next key."""
    shape = (len(jax.tree.leaves(start)[0]), task.action_size)

    def one(carry, _):
        state, key = carry
        key, action_key = jax.random.split(key)
        action = jax.random.uniform(action_key, shape, minval=task.action_low, maxval=task.action_high)
        return (step(state, action), key), None

    (state, key), _ = jax.lax.scan(one, (start, key), length=_STEPS_PER_CALL)
    # The key depends on the last state, so the compiler cannot drop any step.
    return key + jnp.isnan(jnp.concatenate([x.ravel() for x in jax.tree.leaves(state)])).any().astype(key.dtype)


def _init(algorithm: Algorithm) -> TrainState:
    return make_init(algorithm.init)(jax.random.PRNGKey(0))


def _learning_at_once(config: Config, task: Task) -> Algorithm:
    """The algorithm, without learning starts: it learns from the first iteration."""
    settings = config.algo
    if isinstance(settings, OffPolicyConfig):
        settings = dataclasses.replace(settings, learning_starts=0)
    return make_algorithm(task, config.num_envs, config.evaluation, settings)


def _iteration_times(
    config: Config, algorithm: Algorithm, fused: bool, physics_speed: float, seconds: float
) -> Iterator[Measurement]:
    """Time collecting and learning in one iteration, and the least time that each could take."""
    collecting, learning = time_parts(algorithm, config.iterations_per_call, fused, seconds)
    dtype = config.algo.network_dtype
    flops, peak = learning_flops(algorithm), matmul_speed(dtype, seconds)
    yield Measurement("an iteration: collecting", collecting * 1e3, "ms")
    physics_alone = algorithm.steps_per_iteration / physics_speed
    yield Measurement("  of which physics alone would take", physics_alone * 1e3, "ms")
    yield Measurement("an iteration: learning", learning * 1e3, "ms")
    yield Measurement("  of which matrix products alone would take", flops / peak * 1e3, "ms")
    yield Measurement(f"products of large matrices, {dtype}", peak / 1e12, "TFLOP/s")


def time_parts(algorithm: Algorithm, iterations_per_call: int, fused: bool, seconds: float) -> tuple[float, float]:
    """Seconds of collecting and of learning in one iteration.

    Collecting is timed in calls of several iterations that only collect. In a program that collects once, Warp's
    arrays move from call to call, and Warp records its kernels again whenever they move.

    Args:
        algorithm: learns from its first iteration.
        iterations_per_call: as in the training loop.
        fused: see `make_step`.
        seconds: least time to measure each part.
    """
    only_collect = make_step(algorithm.collect, _read_batch, iterations_per_call, fused)
    state, collecting = _seconds_per_call(lambda state: only_collect(state)[0], _init(algorithm), seconds)
    state, batch = jax.jit(algorithm.collect, donate_argnums=0)(state)
    learn = jax.jit(algorithm.learn, donate_argnums=0)
    _, learning = _seconds_per_call(lambda state: learn(state, batch)[0], state, seconds)
    return collecting / iterations_per_call, learning


def _reduced_bytes(config: Config, task: Task) -> float:
    """Bytes that each device gives to the reductions over several devices in one iteration."""
    algorithm = make_algorithm(task, config.num_envs, config.evaluation, config.algo, axis_name=DEVICES)
    return reduced_bytes(algorithm, num_devices=2)


def _read_batch(state: TrainState, batch: PyTree) -> tuple[TrainState, Metrics]:
    """Stand in for `learn`: read the batch, so that the compiler keeps it."""
    total = jnp.stack([jnp.sum(x, dtype=jnp.float32) for x in jax.tree.leaves(batch)]).sum()
    return state, as_means({"batch": total})


def matmul_speed(dtype: str, seconds: float) -> float:
    """Floating-point operations per second of a large square matrix product on this device, at the set precision."""
    size = 8192 if jax.default_backend() != "cpu" else 1024
    matrix = jax.random.normal(jax.random.PRNGKey(0), (size, size), dtype)
    product = jax.jit(lambda a: jax.lax.fori_loop(0, 10, lambda _, a: (a @ matrix) / size**0.5, a))
    return 10 * 2 * size**3 / _seconds_per_call(product, matrix, seconds)[1]


def _insert_times(task: Task) -> Iterator[Measurement]:
    """Time inserting 4,096 transitions into a replay buffer of about a million, empty and full."""
    num_envs, num_rows, unroll, repeats = 1024, 1000, 4, 50
    buffer = ReplayBuffer(task, num_envs, num_rows)
    shape = (unroll, num_envs)
    obs, flags = jnp.zeros((*shape, task.observation_size)), jnp.zeros(shape, bool)
    steps = Steps(obs, jnp.zeros((*shape, task.action_size)), jnp.zeros(shape), flags, flags, obs)
    insert = jax.jit(buffer.insert, donate_argnums=0)
    replay = jax.block_until_ready(insert(buffer.init(), steps))
    for name, rows in (("empty", 0), ("full", num_rows)):
        replay = jax.block_until_ready(replay.replace(rows=jnp.int32(rows)))
        start = time.monotonic()
        for _ in range(repeats):
            replay = insert(replay, steps)
        jax.block_until_ready(replay)
        seconds = (time.monotonic() - start) / repeats
        yield Measurement(f"insert of 4,096 transitions, {name} replay", seconds * 1e6, "µs")


def _peak_memory() -> Iterator[Measurement]:
    """Highest memory use so far, of the process and of JAX's allocator on a GPU."""
    unit = 1024 if sys.platform == "darwin" else 1
    kibibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    yield Measurement("peak memory, host", kibibytes / 2**20, "GiB")
    stats = default_device().memory_stats()
    if stats:
        yield Measurement("peak memory, device (JAX)", stats["peak_bytes_in_use"] / 2**30, "GiB")


if __name__ == "__main__":
    parsing.main(main)
