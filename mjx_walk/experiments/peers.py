"""Other people's trainers, run as they are, to compare with."""

import time
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac

from mjx_walk.algos.sac import SACConfig, make_sac
from mjx_walk.envs import State, TaskOptions, TrainableTask
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.training.trainer import make_chunk, make_init

_UNROLL_LENGTH = 10
_EPISODE_LENGTH = 1000


class BraxTask(TrainableTask):
    """An environment of Brax's behind the face of a `Task`, so that our trainer and Brax's meet on the same one."""

    def __init__(self, env: brax.envs.Env):
        self.env = env
        self.options = TaskOptions(name="brax", max_episode_steps=_EPISODE_LENGTH)
        self.max_episode_steps = _EPISODE_LENGTH
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
    """Put back the function that JAX 0.10 removed and Brax 0.14.2 still calls; nothing where it exists."""
    if hasattr(jax, "device_put_replicated"):
        return

    def device_put_replicated(tree: Any, devices: list[jax.Device]) -> Any:
        assert len(devices) == 1, "the stand-in serves one device"
        return jax.tree.map(lambda x: jax.device_put(jnp.asarray(x)[None], devices[0]), tree)

    jax.device_put_replicated = device_put_replicated  # type: ignore[assignment]


def brax_ppo_speed(num_envs: int, batch_size: int, num_minibatches: int, num_updates: int) -> float:
    """Steady environment steps per second of Brax's PPO on Brax's own, reduced `humanoid`.

    Settings: those of Brax's training notebook where they are not arguments; there 2,048, 1,024 and 32.

    Args:
        num_envs: copies, a divisor of `batch_size × num_minibatches`.
        batch_size: pieces of ten steps in a minibatch.
        num_minibatches: minibatches of an update.
        num_updates: updates measured, after as many that compile and warm up.
    """
    restore_device_put_replicated()
    clock: list[tuple[float, int]] = []
    ppo.train(
        environment=brax.envs.get_environment("humanoid", backend="mjx"),
        num_timesteps=2 * num_updates * batch_size * num_minibatches * _UNROLL_LENGTH,
        num_evals=3,  # so that the clock is read after each half
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


def sac_update_speeds(
    num_envs: int, batch_size: int, grad_updates_per_step: int, replay_capacity: int, num_steps: int
) -> tuple[float, float]:
    """Gradient updates per second of our SAC and of Brax's, on Brax's `humanoid`, once the replay is full.

    Environment, networks (256-256), batch, updates per step and replay are the same; an update is one of critic,
    policy and temperature.

    Args:
        num_envs: copies.
        batch_size: of an update.
        grad_updates_per_step: for each step of all copies.
        replay_capacity: transitions, all of them filled under an untrained policy before the clock starts.
        num_steps: steps of all copies that are timed, after as many that compile and warm up.

    Returns:
        Ours and theirs.
    """
    env = brax.envs.get_environment("humanoid", backend="mjx")
    config = SACConfig(
        unroll_length=1,
        grad_updates_per_step=grad_updates_per_step,
        batch_size=batch_size,
        replay_capacity=replay_capacity,
        learning_starts=replay_capacity,
        observation_clip=None,
    )
    algorithm = make_sac(BraxTask(env), num_envs, EvaluationConfig(1), config)  # type: ignore[arg-type]
    chunk = make_chunk(algorithm, num_steps, fused=True)
    state = make_init(algorithm)(jax.random.PRNGKey(0))
    while int(state.critic_updates) == 0:
        state, _ = chunk(state)
    before, start = int(state.critic_updates), time.monotonic()
    state, _ = jax.block_until_ready(chunk(state))
    ours = (int(state.critic_updates) - before) / (time.monotonic() - start)
    del state

    restore_device_put_replicated()
    speeds: list[float] = []
    prefill = -(-replay_capacity // num_envs) * num_envs
    sac.train(
        environment=env,
        num_timesteps=prefill + 2 * num_steps * num_envs,
        num_evals=3,  # so that two pieces of equal length are timed; the first one compiles
        num_eval_envs=1,
        episode_length=_EPISODE_LENGTH,
        num_envs=num_envs,
        learning_rate=config.policy_learning_rate,
        discounting=config.discount,
        batch_size=batch_size,
        normalize_observations=True,
        tau=config.tau,
        min_replay_size=replay_capacity,
        max_replay_size=replay_capacity,
        grad_updates_per_step=grad_updates_per_step,
        network_factory=lambda *args, **kwargs: sac_networks.make_sac_networks(
            *args, hidden_layer_sizes=(256, 256), **kwargs
        ),
        progress_fn=lambda _, metrics: speeds.append(float(metrics.get("training/sps", 0.0))),
    )
    return ours, speeds[-1] / num_envs * grad_updates_per_step
