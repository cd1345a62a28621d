"""`python -m mjx_walk.bench env=humanoid`: what this machine does, beside Gymnasium on one of its cores."""

import dataclasses
import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp

from mjx_walk.algos import make_algorithm
from mjx_walk.algos.off_policy import OffPolicyConfig
from mjx_walk.api import resolve
from mjx_walk.common.replay_buffer import ReplayBuffer, Steps
from mjx_walk.envs import State, Task
from mjx_walk.envs.physics import make_engine
from mjx_walk.experiments import profile, timing
from mjx_walk.runs.config import Config
from mjx_walk.runs.policies import make_task
from mjx_walk.training import launcher
from mjx_walk.training.trainer import make_chunk, make_init
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm
from mjx_walk.utils.versions import package_versions

USAGE = """
usage: python -m mjx_walk.bench [env=humanoid] [algo=ppo] [KEY=VALUE ...] [seconds=5] [devices=all] [peers=false]
                                [out=bench.json]

  KEY=VALUE  as for train: physics=jax num_envs=2048 algo.num_epochs=4; otherwise the recipe for this hardware
  seconds    how long each speed is measured
  devices    also training on 1, 2, 4 … GPUs of this host, up to so many: a process and num_envs copies each
  peers      also Brax's PPO (algo=ppo) or SAC (algo=sac) on Brax's own, reduced humanoid: some minutes, most of
             them compiling
  out        the table as JSON, with versions
"""


@dataclasses.dataclass
class Arguments:
    seconds: float = setting(5.0, above=0)
    devices: Any = None
    peers: bool = False
    out: str | None = None


def main(arguments: list[str]) -> None:
    """Measure, print a table, write JSON if asked."""
    parsed, overrides = cli.parse_own(Arguments, Config, arguments, USAGE)
    config = resolve(overrides)
    algo = config.algo.name
    if parsed.peers and algo not in ("ppo", "sac"):
        raise UserError(f"Brax has no {algo} to compare with; leave peers out, or choose algo=ppo or algo=sac")
    jax.config.update("jax_default_matmul_precision", config.matmul_precision)
    if parsed.out:
        cli.check_writable(Path(parsed.out))
    sizes = device_counts(parsed.devices)
    print("Short trainings, in processes of their own …", flush=True)
    # Before this process takes the device's memory.
    first_chunks = timing.first_chunk_times(overrides)
    speeds = timing.speeds_by_devices(overrides, sizes, parsed.seconds)
    task = make_task(config)
    device = f"{jax.devices()[0].device_kind}, physics={task.engine.name}, {config.num_envs} copies"
    print(f"{task.gymnasium_id} on {device}", flush=True)
    results: dict[str, float] = {}

    def report(name: str, value: float, unit: str) -> None:
        results[name] = value
        print(f"  {name:<44} {value:>12,.1f} {unit}", flush=True)

    for name, value in first_chunks.items():
        report(f"compile and first chunk, {name} caches", value, "s")
    for size, speed in speeds.items():
        report(f"training on {size} {'device' if size == 1 else 'devices'}", speed, "env-steps/s")
        if size > 1:
            report(f"  times that on 1, of {size}", speed / speeds[1], "times")
    gym_speed = gymnasium_speed(task, parsed.seconds)
    report("Gymnasium, one core", gym_speed, "env-steps/s")
    for name, measure in {
        "physics only": physics_speed,
        "physics, observation and reward": step_speed,
    }.items():
        report(name, measure(task, config.num_envs, parsed.seconds), "env-steps/s")
    algorithm = _learning_at_once(config, task)
    fused = not task.engine.calls_host
    report("training", training_speed(config, algorithm, fused, parsed.seconds), "env-steps/s")
    report("training / Gymnasium on one core", results["training"] / gym_speed, "times")
    for name, value, unit in where_time_goes(config, algorithm, fused, results["physics only"], parsed.seconds):
        report(name, value, unit)
    for name, value in peak_memory().items():
        report(name, value, "GiB")
    if isinstance(config.algo, OffPolicyConfig):
        for name, value in insert_times(task).items():
            report(name, value * 1e6, "µs")
    if parsed.peers:
        for name, value, unit in peer_figures(algo, config.hardware):
            report(name, value, unit)
    if parsed.out:
        content = {"env": task.gymnasium_id, "device": device, "results": results, "versions": package_versions()}
        Path(parsed.out).write_text(json.dumps(content, indent=1))


def device_counts(asked: Any) -> list[int]:
    """1, 2, 4 … and how many are asked for; none if that is unset.

    Raises:
        UserError: this host has fewer GPUs.
    """
    if asked is None:
        return []
    most = launcher.count(asked)
    return sorted({most} | {2**power for power in range(most.bit_length())})


def gymnasium_speed(task: Task, seconds: float) -> float:
    """Steps per second of the real environment under random actions, resets included."""
    env = gymnasium.make(task.gymnasium_id, **task.gymnasium_kwargs())
    env.reset(seed=0)
    start, steps = time.monotonic(), 0
    while time.monotonic() - start < seconds:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        steps += 1
        if terminated or truncated:
            env.reset()
    return steps / (time.monotonic() - start)


_STEPS_PER_CALL = 25
"""About as long as a random policy keeps a humanoid up. Every call starts from resets, as Gymnasium's episodes do."""


def _speed_under_random_actions(
    task: Task, num_envs: int, seconds: float, begin: Callable[[State], Any], step: Callable[[Any, jax.Array], Any]
) -> float:
    start = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.PRNGKey(0), num_envs))

    @jax.jit
    def advance(key):
        def one(carry, _):
            state, key = carry
            key, action_key = jax.random.split(key)
            low, high = task.action_low, task.action_high
            action = jax.random.uniform(action_key, (num_envs, task.action_size), minval=low, maxval=high)
            return (step(state, action), key), None

        (state, key), _ = jax.lax.scan(one, (begin(start), key), length=_STEPS_PER_CALL)
        # The key depends on the last state, so that nothing can be left out.
        return key + jnp.isnan(jnp.concatenate([x.ravel() for x in jax.tree.leaves(state)])).any().astype(key.dtype)

    return profile.steps_per_second(advance, jax.random.PRNGKey(1), num_envs * _STEPS_PER_CALL, seconds)


def physics_speed(task: Task, num_envs: int, seconds: float) -> float:
    """Environment steps per second of the engine alone, no array derived."""
    engine = make_engine(task.engine.name, task.model, task.options.frame_skip, ())
    step = jax.vmap(lambda state, action: engine.step(state, action)[0])
    return _speed_under_random_actions(task, num_envs, seconds, lambda state: state.physics, step)


def step_speed(task: Task, num_envs: int, seconds: float) -> float:
    """The same with observation, reward and termination."""
    return _speed_under_random_actions(task, num_envs, seconds, lambda state: state, jax.vmap(task.step))


def training_speed(config: Config, algorithm: Algorithm, fused: bool, seconds: float) -> float:
    """Steps per second of the chunks that the loop runs, one after the other; nothing is logged or saved."""
    chunk = make_chunk(algorithm, config.iterations_per_call, fused)
    state = make_init(algorithm)(jax.random.PRNGKey(0))
    steps_per_call = algorithm.steps_per_iteration * config.iterations_per_call
    return profile.steps_per_second(lambda state: chunk(state)[0], state, steps_per_call, seconds)


def _learning_at_once(config: Config, task: Task) -> Algorithm:
    """The algorithm, which fills no replay before it learns."""
    settings = config.algo
    if isinstance(settings, OffPolicyConfig):
        settings = dataclasses.replace(settings, learning_starts=0)
    return make_algorithm(task, config.num_envs, config.evaluation, settings)


def where_time_goes(
    config: Config, algorithm: Algorithm, fused: bool, physics_speed: float, seconds: float
) -> list[tuple[str, float, str]]:
    """Names, values and units: of one update, what collecting and learning take, and the least that each could."""
    parts = profile.time_parts(algorithm, config.iterations_per_call, fused, seconds)
    flops, peak = profile.learning_flops(algorithm), profile.matmul_speed(config.algo.network_dtype, seconds)
    return [
        ("an update: collecting", parts["collecting"] * 1e3, "ms"),
        ("  of which physics alone would take", algorithm.steps_per_iteration / physics_speed * 1e3, "ms"),
        ("an update: learning", parts["learning"] * 1e3, "ms"),
        ("  of which matrix products alone would take", flops / peak * 1e3, "ms"),
        (f"products of large matrices, {config.algo.network_dtype}", peak / 1e12, "TFLOP/s"),
    ]


def insert_times(task: Task) -> dict[str, float]:
    """Seconds that inserting 4,096 transitions into a replay of a million takes, empty and full."""
    num_envs, num_rows, unroll, repeats = 1024, 1000, 4, 50
    buffer = ReplayBuffer(task, num_envs, num_rows)
    shape = (unroll, num_envs)
    obs, flags = jnp.zeros((*shape, task.observation_size)), jnp.zeros(shape, bool)
    steps = Steps(obs, jnp.zeros((*shape, task.action_size)), jnp.zeros(shape), flags, flags, obs)
    insert = jax.jit(buffer.insert, donate_argnums=0)
    replay = jax.block_until_ready(insert(buffer.init(), steps))
    times = {}
    for name, rows in (("empty", 0), ("full", num_rows)):
        replay = jax.block_until_ready(replay.replace(rows=jnp.int32(rows)))
        start = time.monotonic()
        for _ in range(repeats):
            replay = insert(replay, steps)
        jax.block_until_ready(replay)
        times[f"insert of 4,096 transitions, {name} replay"] = (time.monotonic() - start) / repeats
    return times


def peer_figures(algo: str, hardware: str) -> list[tuple[str, float, str]]:
    """Names, values and units of what Brax's trainer of the same algorithm reaches on this machine."""
    from mjx_walk.experiments import peers  # Brax's trainers take seconds to import

    if algo == "ppo":
        ppo_sizes = (2048, 1024, 32, 30) if hardware == "gpu" else (32, 16, 2, 3)
        speed = peers.brax_ppo_speed(*ppo_sizes)
        return [(f"Brax's PPO on its reduced humanoid, {ppo_sizes[0]} copies", speed, "env-steps/s")]
    sac_sizes = (128, 512, 8, 1_000_000, 300) if hardware == "gpu" else (16, 64, 4, 20_000, 20)
    ours, theirs = peers.sac_update_speeds(*sac_sizes)
    return [
        ("our SAC on Brax's humanoid", ours, "updates/s"),
        ("Brax's SAC on Brax's humanoid", theirs, "updates/s"),
        ("ours / Brax's", ours / theirs, "times"),
    ]


def peak_memory() -> dict[str, float]:
    """Highest memory use so far: of the process, and on a GPU of JAX's allocator there."""
    unit = 1024 if sys.platform == "darwin" else 1
    peaks = {"peak memory, host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit / 2**20}
    stats = jax.devices()[0].memory_stats()
    if stats:
        peaks["peak memory, device (JAX)"] = stats["peak_bytes_in_use"] / 2**30
    return peaks


if __name__ == "__main__":
    cli.main(main)
