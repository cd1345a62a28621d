"""What off-policy algorithms share: act with noise, store, sample, learn. Each brings a `Learner`."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax
import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.networks import ACTIVATION

from mjx_walk.common import networks, returns, rollout
from mjx_walk.common.replay_buffer import Replay, ReplayBuffer, Steps
from mjx_walk.common.schedules import anneal, anneal_discount, factor
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig, InlineEvaluator
from mjx_walk.envs.vector_env import VectorEnv, VectorState
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm, Metrics, PolicyFn, Transition


@dataclasses.dataclass
class OffPolicyConfig:
    """Settings that all off-policy algorithms have."""

    unroll_length: int = setting(4, at_least=1)
    """Steps of all copies between two phases of learning."""
    grad_updates_per_step: int = setting(8, at_least=1)
    """Critic updates for each step of all copies."""
    policy_delay: int = setting(1, at_least=1)
    """Critic updates for each policy update."""
    batch_size: int = setting(4096, at_least=1)
    replay_capacity: int = setting(1_000_000, at_least=1)
    """Transitions, rounded up to whole unrolls."""
    replay_dtype: str = setting("float32", choices=("float32", "bfloat16"))
    """Of the observations stored."""
    learning_starts: int = setting(10_000, at_least=0)
    """Environment steps under uniformly random actions, before learning begins."""
    noise_repeat: int = setting(1, at_least=1)
    """Steps that the same draw of exploration noise is kept for."""
    n_step: int = setting(1, at_least=1)
    discount: float = setting(0.99, at_least=0, at_most=1)
    final_discount: float | None = setting(None, at_least=0, below=1)
    """What it becomes over `schedule_steps`: its horizon 1 / (1 - γ) changes by the same factor every step."""
    tau: float = setting(0.005, above=0, at_most=1)
    """How far target networks move at each update of theirs."""
    policy_learning_rate: float = setting(3e-4, above=0)
    critic_learning_rate: float = setting(3e-4, above=0)
    learning_rate_schedule: str = setting("constant", choices=("constant", "linear"))
    """`linear`: to zero over `schedule_steps`."""
    schedule_steps: int = setting(100_000_000, at_least=1)
    """Environment steps over which schedules run. Fixed, so that stopping early does not change the path."""
    max_grad_norm: float | None = setting(None, above=0)
    reward_scale: float = setting(1.0, above=0)
    normalize_rewards: bool = False
    """Divide rewards by the running std of the discounted return, before `reward_scale`."""
    normalized_return_max: float | None = setting(None, above=0)
    """Divide them by more, if it takes that to keep every discounted return seen within this."""
    normalize_observations: bool = True
    observation_clip: float | None = setting(10.0, above=0)
    """Bound of normalised observations."""
    policy_hidden_layer_sizes: tuple[int, ...] = setting((256, 256), at_least=1)
    critic_hidden_layer_sizes: tuple[int, ...] = setting((256, 256), at_least=1)
    policy_layer_norm: bool = False
    critic_layer_norm: bool = False
    activation: str = setting("relu", choices=tuple(ACTIVATION))
    network_dtype: str = setting("float32", choices=("float32", "bfloat16"))
    """That the networks compute in. Parameters, losses and optimizers are float32."""
    init_at_random_episode_step: bool = True


class Batch(NamedTuple):
    """What a learner learns from, and with which settings of the moment."""

    transitions: Transition
    """`[N, …]`, see `ReplayBuffer.sample`; observations normalised, actions in `[-1, 1]`."""
    reward_scale: jax.Array
    rate_factor: jax.Array | float
    """The learning rates' share that is left."""
    remaining: jax.Array | float
    """The share of `schedule_steps` that is left."""


class Learner(NamedTuple):
    """The networks of an algorithm, their losses and updates. All observations that it sees are normalised."""

    init: Callable[[jax.Array], Any]
    """`key → state`."""
    policy_params: Callable[[Any], Any]
    """The part of the state that the policy needs."""
    explore: Callable[[Any, jax.Array, jax.Array], jax.Array]
    """`(policy_params, obs [B, …], key) → action [B, action_size]`, in `[-1, 1]`, with noise."""
    act: Callable[[Any, jax.Array, jax.Array, bool], jax.Array]
    """`(policy_params, obs, key, deterministic) → action`, in `[-1, 1]`."""
    critic_update: Callable[[Any, Batch, jax.Array], tuple[Any, Metrics]]
    """`(state, batch, key) → (state, metrics)`, leaving the policy as it is."""
    full_update: Callable[[Any, Batch, jax.Array], tuple[Any, Metrics]]
    """The same for critic and policy."""


class OffPolicyState(flax.struct.PyTreeNode):
    """Everything that influences the next update."""

    learner: Any
    critic_updates: jax.Array
    """`[] i32`: critic updates done."""
    normalizer: RunningStatisticsState
    return_scale: returns.ReturnScale
    replay: Replay
    env: VectorState
    noise_key: jax.Array
    """From which the exploration noise of every step follows."""
    key: jax.Array
    iterations: jax.Array
    """`[] i32`: unrolls done."""


def make_off_policy(
    task: Task, num_envs: int, evaluation: EvaluationConfig, config: OffPolicyConfig, learner: Learner
) -> Algorithm:
    """Build an algorithm around a learner.

    Args:
        task: the unbatched environment.
        num_envs: copies that learn.
        evaluation: of the policy beside them.
        config: settings.
        learner: networks, losses and updates.

    Raises:
        UserError: settings that do not go together.
    """
    updates_per_unroll = config.grad_updates_per_step * config.unroll_length
    if updates_per_unroll % config.policy_delay:
        raise UserError(
            f"algo.grad_updates_per_step={config.grad_updates_per_step} times "
            f"algo.unroll_length={config.unroll_length} must be a multiple of algo.policy_delay={config.policy_delay}"
        )
    steps_per_iteration = num_envs * config.unroll_length
    unrolls_kept = max(
        -(-config.replay_capacity // steps_per_iteration), -(-(config.n_step + 1) // config.unroll_length)
    )
    buffer = ReplayBuffer(task, num_envs, unrolls_kept * config.unroll_length, config.replay_dtype)
    if config.learning_starts > buffer.num_transitions:
        raise UserError(
            f"algo.learning_starts={config.learning_starts} is more than algo.replay_capacity={config.replay_capacity}"
        )
    rows_before_learning = max(-(-config.learning_starts // num_envs), config.n_step + 1)

    def normalize(normalizer: RunningStatisticsState, obs: jax.Array) -> jax.Array:
        return running_statistics.normalize(obs, normalizer, max_abs_value=config.observation_clip)

    def policy(policy_params: Any, deterministic: bool = True) -> PolicyFn:
        normalizer, params = policy_params

        def act(obs: jax.Array, key: jax.Array) -> jax.Array:
            return networks.to_env_action(task, learner.act(params, normalize(normalizer, obs), key, deterministic))

        return act

    def policy_params(state: OffPolicyState) -> Any:
        return (state.normalizer, learner.policy_params(state.learner))

    evaluator = InlineEvaluator(task, num_envs, evaluation, policy, steps_per_iteration)
    env = VectorEnv(task, num_envs, evaluator, config.init_at_random_episode_step)

    def init(key: jax.Array) -> OffPolicyState:
        learner_key, env_key, noise_key, key = jax.random.split(key, 4)
        learner_state = learner.init(learner_key)
        normalizer = networks.init_normalizer(task.observation_size)
        return OffPolicyState(
            learner=learner_state,
            critic_updates=jnp.zeros((), jnp.int32),
            normalizer=normalizer,
            return_scale=returns.init_return_scale(num_envs),
            replay=buffer.init(),
            env=env.init(env_key, (normalizer, learner.policy_params(learner_state))),
            noise_key=noise_key,
            key=key,
            iterations=jnp.zeros((), jnp.int32),
        )

    def collect(state: OffPolicyState) -> tuple[OffPolicyState, tuple[Steps, Metrics]]:
        key, pool_key = jax.random.split(state.key)
        step = state.iterations * config.unroll_length + jnp.arange(config.unroll_length)
        noise_keys = jax.vmap(jax.random.fold_in, (None, 0))(state.noise_key, step // config.noise_repeat)
        is_random = state.iterations * float(steps_per_iteration) < config.learning_starts
        params = learner.policy_params(state.learner)

        def actor(obs, key):
            explore_key, uniform_key = jax.random.split(key)
            chosen = learner.explore(params, normalize(state.normalizer, obs), explore_key)
            uniform = jax.random.uniform(uniform_key, chosen.shape, minval=-1.0, maxval=1.0)
            action = jnp.where(is_random, uniform, chosen)
            return networks.to_env_action(task, action), action

        def keep(step: rollout.Step) -> Steps:
            outcome = step.outcome
            return Steps(step.obs, step.extras, outcome.reward, outcome.terminated, outcome.truncated, outcome.obs)

        env_state, scores = env.renew(state.env, pool_key, policy_params(state), state.iterations)
        env_state, steps, stats = rollout.unroll(env, env_state, actor, noise_keys, keep)
        return state.replace(env=env_state, key=key), (steps, stats | scores)

    def learn(state: OffPolicyState, collected: tuple[Steps, Metrics]) -> tuple[OffPolicyState, Metrics]:
        steps, stats = collected
        key, update_key = jax.random.split(state.key)
        normalizer = state.normalizer
        if config.normalize_observations:
            normalizer = networks.update_normalizer(normalizer, steps.observation)
        remaining = anneal(state.iterations * float(steps_per_iteration), config.schedule_steps)
        discount = anneal_discount(config.discount, config.final_discount, remaining)
        ended = steps.terminated | steps.truncated
        return_scale = returns.update_return_scale(state.return_scale, steps.reward, ended, discount)
        reward_scale = jnp.float32(config.reward_scale)
        if config.normalize_rewards:
            reward_scale *= returns.reward_multiplier(return_scale, config.normalized_return_max)
        rate_factor = factor(config.learning_rate_schedule, remaining)
        replay = buffer.insert(state.replay, steps)

        def as_batch(transitions: Transition) -> Batch:
            return Batch(transitions, reward_scale, rate_factor, remaining)

        def critic_update(learner_state, inputs):
            transitions, key = inputs
            return learner.critic_update(learner_state, as_batch(transitions), key)[0], None

        def policy_period(learner_state, inputs):
            """`policy_delay` critic updates, the last of them together with the policy's."""
            first = jax.tree.map(lambda x: x[:-1], inputs)
            learner_state, _ = jax.lax.scan(critic_update, learner_state, first)
            transitions, key = jax.tree.map(lambda x: x[-1], inputs)
            return learner.full_update(learner_state, as_batch(transitions), key)

        def train(learner_state):
            # Drawn and normalised in one go, since on a GPU small updates wait for the launch of their kernels.
            sample_key, key = jax.random.split(update_key)
            num_transitions = updates_per_unroll * config.batch_size
            drawn = buffer.sample(replay, sample_key, num_transitions, config.n_step, discount)
            drawn = drawn._replace(
                observation=normalize(normalizer, drawn.observation),
                next_observation=normalize(normalizer, drawn.next_observation),
            )
            periods = (updates_per_unroll // config.policy_delay, config.policy_delay)
            drawn = jax.tree.map(lambda x: x.reshape((*periods, config.batch_size, *x.shape[1:])), drawn)
            learner_state, metrics = jax.lax.scan(policy_period, learner_state, (drawn, jax.random.split(key, periods)))
            return learner_state, jax.tree.map(lambda x: x.mean(axis=0), metrics)

        def wait(learner_state):
            shapes = jax.eval_shape(train, learner_state)[1]
            return learner_state, jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

        can_learn = replay.rows >= rows_before_learning
        learner_state, metrics = jax.lax.cond(can_learn, train, wait, state.learner)
        new_state = state.replace(
            learner=learner_state,
            critic_updates=state.critic_updates + jnp.where(can_learn, updates_per_unroll, 0),
            normalizer=normalizer,
            return_scale=return_scale,
            replay=replay,
            key=key,
            iterations=state.iterations + 1,
        )
        return new_state, stats | metrics | {
            "critic_updates": jnp.float32(new_state.critic_updates),
            "replay_transitions": jnp.minimum(replay.rows, buffer.num_rows) * jnp.float32(num_envs),
            "reward_scale": reward_scale,
        }

    return Algorithm(init, collect, learn, policy_params, policy, steps_per_iteration, replay_bytes=buffer.num_bytes)
