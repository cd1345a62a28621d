"""`python benchmarks/peers.py algo=ppo`: speed of Brax's trainer on Brax's own, reduced humanoid."""

import dataclasses
import functools
import time
from collections.abc import Iterator
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac

from mjx_walk.algos.sac import SAC, SACConfig
from mjx_walk.api import resolve
from mjx_walk.bench import show, write
from mjx_walk.cli import parsing
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.envs import State, TaskOptions, TrainableTask
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.experiments.timing import Measurement
from mjx_walk.machine.devices import default_device
from mjx_walk.settings.config import Config
from mjx_walk.settings.overrides import key_of_value
from mjx_walk.storage.files import user_path
from mjx_walk.training.programs import make_init, make_step
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PyTree

__all__ = [
    "USAGE",
    "Arguments",
    "BraxTask",
    "brax_ppo_speed",
    "brax_sac_speed",
    "main",
    "measure",
    "restore_device_put_replicated",
    "sac_speed",
]

USAGE = """
usage: python benchmarks/peers.py [algo=ppo|sac] [hardware=gpu|cpu] [KEY=VALUE ...] [out=peers.json]

  algo       Brax's PPO, or Brax's SAC next to ours; each takes some minutes, mostly to compile
  hardware   cpu or gpu, the size of the training; by default this machine's
  KEY=VALUE  as for train; of them only matmul_precision has an effect
  out        write the table as JSON, with package versions
"""

_UNROLL_LENGTH = 10
_EPISODE_LENGTH = 1000
_SAC_SIZES: dict[str, dict[str, Any]] = {
    "gpu": {"batch_size": 512, "grad_updates_per_step": 8, "replay_capacity": 1_000_000, "learning_starts": 1_000_000},
    "cpu": {"batch_size": 64, "grad_updates_per_step": 4, "replay_capacity": 20_000, "learning_starts": 20_000},
}


@dataclasses.dataclass
class Arguments:
    """Arguments that are not settings of a training."""

    out: str | None = None


def main(command_line: list[str]) -> None:
    """Measure, print a table, and write JSON if asked."""
    arguments, overrides = parsing.parse_own(Arguments, Config, command_line, USAGE, key_of_value)
    config = resolve(overrides)
    if config.algo.name not in ("ppo", "sac"):
        raise UserError(f"Brax has no {config.algo.name} to compare with; choose algo=ppo or algo=sac")
    jax.config.update("jax_default_matmul_precision", config.matmul_precision)
    if arguments.out:
        parsing.check_writable(user_path(arguments.out))
    device = default_device().device_kind
    print(f"Brax's humanoid on {device}", flush=True)
    results = show(measure(config.algo.name, config.hardware))
    if arguments.out:
        write(arguments.out, "Brax's humanoid", device, results)


def measure(algo: str, hardware: str) -> Iterator[Measurement]:
    """Measure Brax's trainer of an algorithm, and for SAC also ours, on Brax's `humanoid`.

    Args:
        algo: `ppo` or `sac`.
        hardware: `gpu` or `cpu`, the size of the training.
    """
    env = brax.envs.get_environment("humanoid", backend="mjx")
    if algo == "ppo":
        num_envs, *sizes = (2048, 1024, 32, 30) if hardware == "gpu" else (32, 16, 2, 3)
        speed = brax_ppo_speed(env, num_envs, *sizes)
        yield Measurement(f"Brax's PPO on its reduced humanoid, {num_envs} environments", speed, "env-steps/s")
        return
    num_envs, num_steps = (128, 300) if hardware == "gpu" else (16, 20)
    config = SACConfig(unroll_length=1, observation_clip=None, **_SAC_SIZES[hardware])
    ours = sac_speed(env, num_envs, config, num_steps)
    yield Measurement("our SAC on Brax's humanoid", ours, "updates/s")
    theirs = brax_sac_speed(env, num_envs, config, num_steps)
    yield Measurement("Brax's SAC on Brax's humanoid", theirs, "updates/s")
    yield Measurement("ours / Brax's", ours / theirs, "times")


class BraxTask(TrainableTask):
    """A Brax environment with the interface of a `Task`, so that both trainers run on the same environment."""

    def __init__(self, env: brax.envs.Env):
        self.env = env
        self.options = TaskOptions(name="brax", max_episode_steps=_EPISODE_LENGTH)
        self.max_episode_steps = _EPISODE_LENGTH
        self.dt = float(env.dt)
        self.observation_size, self.action_size = env.observation_size, env.action_size
        self.action_low, self.action_high = -jnp.ones(env.action_size), jnp.ones(env.action_size)
        self.reward_terms: tuple[str, ...] = ()

    def reset(self, key: jax.Array) -> State:
        return self._state(self.env.reset(key), jnp.zeros((), jnp.int32))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(self.env.step(state.memory["brax"], action), state.steps + 1)

    def _state(self, theirs: brax.envs.State, steps: jax.Array) -> State:
        empty, zero = jnp.zeros(0), jnp.float32(0.0)
        return State(
            physics=PhysicsState(empty, empty, empty),
            memory={"brax": theirs},
            obs=theirs.obs,
            reward=jnp.float32(theirs.reward),
            terminated=theirs.done > 0.5,
            truncated=steps >= _EPISODE_LENGTH,
            steps=steps,
            metrics={"nonfinite": zero, "overflow": zero},
        )


def restore_device_put_replicated() -> None:
    """Restore the function that JAX 0.10 removed and Brax 0.14.2 still calls. Do nothing where JAX has it."""
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = _device_put_replicated  # type: ignore[assignment]


def _device_put_replicated(tree: PyTree, devices: list[jax.Device]) -> PyTree:
    assert len(devices) == 1, "the replacement supports one device"
    return jax.tree.map(lambda x: jax.device_put(jnp.asarray(x)[None], devices[0]), tree)


def brax_ppo_speed(
    env: brax.envs.Env, num_envs: int, batch_size: int, num_minibatches: int, num_iterations: int
) -> float:
    """Environment steps per second of Brax's PPO, after compilation.

    Source: the settings of Brax's training notebook; it has 2,048 environments, a batch size of 1,024 and 32
    minibatches.

    Args:
        env: Brax's environment.
        num_envs: environments, a divisor of `batch_size × num_minibatches`.
        batch_size: unrolls of ten steps in a minibatch.
        num_minibatches: minibatches of an iteration.
        num_iterations: iterations timed, after as many that compile and warm up.
    """
    restore_device_put_replicated()
    clock: list[tuple[float, int]] = []
    ppo.train(
        environment=env,
        num_timesteps=2 * num_iterations * batch_size * num_minibatches * _UNROLL_LENGTH,
        num_evals=3,  # the clock is read after each half
        episode_length=_EPISODE_LENGTH,
        num_envs=num_envs,
        unroll_length=_UNROLL_LENGTH,
        batch_size=batch_size,
        num_minibatches=num_minibatches,
        num_updates_per_batch=8,
        discounting=0.97,
        learning_rate=3e-4,
        entropy_cost=1e-3,
        reward_scaling=0.1,
        normalize_observations=True,
        num_eval_envs=8,
        run_evals=False,
        progress_fn=lambda steps, _: clock.append((time.monotonic(), steps)),
    )
    (start, steps_before), (end, steps_after) = clock[-2:]
    return (steps_after - steps_before) / (end - start)


def sac_speed(env: brax.envs.Env, num_envs: int, config: SACConfig, num_steps: int) -> float:
    """Gradient updates per second of our SAC once the replay is full; an update is of critic, policy and temperature.

    Args:
        env: Brax's environment.
        num_envs: environments.
        config: `learning_starts` fills the replay under an untrained policy before the clock starts.
        num_steps: steps of all environments that are timed, after as many that compile and warm up.
    """
    algorithm = SAC(BraxTask(env), num_envs, EvaluationConfig(1), config)  # type: ignore[arg-type]
    call = make_step(algorithm.collect, algorithm.learn, num_steps, fused=True)
    state: Any = make_init(algorithm.init)(jax.random.PRNGKey(0))
    while int(state.critic_updates) == 0:
        state, _ = call(state)
    before, start = int(state.critic_updates), time.monotonic()
    state, _ = jax.block_until_ready(call(state))
    return (int(state.critic_updates) - before) / (time.monotonic() - start)


def brax_sac_speed(env: brax.envs.Env, num_envs: int, config: SACConfig, num_steps: int) -> float:
    """Gradient updates per second of Brax's SAC under the settings of ours; arguments as for `sac_speed`."""
    restore_device_put_replicated()
    speeds: list[float] = []
    prefill = -(-config.replay_capacity // num_envs) * num_envs
    sac.train(
        environment=env,
        num_timesteps=prefill + 2 * num_steps * num_envs,
        num_evals=3,  # the training has two timed halves, of which the first one compiles
        num_eval_envs=1,
        episode_length=_EPISODE_LENGTH,
        num_envs=num_envs,
        learning_rate=config.policy_learning_rate,
        discounting=config.discount,
        batch_size=config.batch_size,
        normalize_observations=True,
        tau=config.tau,
        min_replay_size=config.replay_capacity,
        max_replay_size=config.replay_capacity,
        grad_updates_per_step=config.grad_updates_per_step,
        network_factory=functools.partial(
            sac_networks.make_sac_networks, hidden_layer_sizes=tuple(config.policy_hidden_layer_sizes)
        ),
        progress_fn=lambda _, metrics: speeds.append(float(metrics.get("training/sps", 0.0))),
    )
    return speeds[-1] / num_envs * config.grad_updates_per_step


if __name__ == "__main__":
    parsing.main(main)
