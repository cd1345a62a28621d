"""Base of SAC, TD3 and DDPG: acting with noise, the replay, n-step targets, and the schedule of gradient updates."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import ClassVar, Generic, TypeVar

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.algos.base import Algorithm
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.algos.off_policy_state import Batch, LearnerT, OffPolicyState
from mjx_walk.common import networks, returns, rollout
from mjx_walk.common.optimizers import anneal_discount, apply_gradients, make_adam, remaining_fraction, schedule_factor
from mjx_walk.common.replay_buffer import Replay, ReplayBuffer, Steps
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Losses, Metrics, Params, PolicyFn, PolicyParams, as_means

__all__ = ["OffPolicyAlgorithm"]

_OffPolicyConfigT = TypeVar("_OffPolicyConfigT", bound=OffPolicyConfig)
_ParamsT = TypeVar("_ParamsT")

_NOISE_SECONDS = 0.064
"""Time for which a sample of exploration noise is kept, by default: a fraction of a stride."""
_TARGET_SECONDS = 0.04
"""Time whose rewards a critic's target sums up, by default."""


@dataclasses.dataclass(frozen=True, eq=False)
class OffPolicyAlgorithm(
    Algorithm[OffPolicyState[LearnerT], tuple[Steps, Metrics], _OffPolicyConfigT], Generic[LearnerT, _OffPolicyConfigT]
):
    """Stores steps in a replay and learns from samples of it. Subclasses define networks, losses and updates.

    All observations that a subclass sees are normalized, and all its actions lie in `[-1, 1]`.

    Raises:
        UserError: settings that exclude each other.
    """

    random_step_after_falls: ClassVar[bool] = True

    buffer: ReplayBuffer = dataclasses.field(init=False, repr=False)
    optimizer: optax.GradientTransformation = dataclasses.field(init=False, repr=False)
    n_step: int = dataclasses.field(init=False)
    """Steps whose rewards a critic's target sums up."""
    noise_repeat: int = dataclasses.field(init=False)
    """Steps for which a sample of exploration noise is kept."""

    def __post_init__(self) -> None:
        config = self.config
        self._set(
            n_step=config.n_step or steps_of(_TARGET_SECONDS, self.task.dt),
            noise_repeat=config.noise_repeat or steps_of(_NOISE_SECONDS, self.task.dt),
        )
        if self.updates_per_iteration % config.policy_delay:
            raise UserError(
                f"algo.grad_updates_per_step={config.grad_updates_per_step} times "
                f"algo.unroll_length={config.unroll_length} must be a multiple of "
                f"algo.policy_delay={config.policy_delay}"
            )
        num_unrolls = max(
            -(-config.replay_capacity // self.steps_per_iteration), -(-(self.n_step + 1) // config.unroll_length)
        )
        num_rows = num_unrolls * config.unroll_length
        self._set(buffer=ReplayBuffer(self.task, self.num_envs, num_rows, config.replay_dtype))
        if config.learning_starts > self.buffer.num_transitions:
            raise UserError(
                f"algo.learning_starts={config.learning_starts} is more than "
                f"algo.replay_capacity={config.replay_capacity}"
            )
        self._set(optimizer=make_adam(config.max_grad_norm))
        super().__post_init__()

    # What an algorithm defines.

    @abc.abstractmethod
    def init_learner(self, key: PRNGKeyArray) -> LearnerT:
        """Networks and optimizers before the first update."""

    @abc.abstractmethod
    def act(
        self, params: Params, obs: Float[Array, "*B observation_size"], key: PRNGKeyArray, deterministic: bool
    ) -> Float[Array, "*B action_size"]:
        """Actions of the policy."""

    @abc.abstractmethod
    def explore(
        self, params: Params, obs: Float[Array, "*B observation_size"], key: PRNGKeyArray
    ) -> Float[Array, "*B action_size"]:
        """Actions of the policy with exploration noise."""

    @abc.abstractmethod
    def critic_update(self, learner: LearnerT, batch: Batch, key: PRNGKeyArray) -> tuple[LearnerT, Losses]:
        """One gradient step on the critics: `(learner, metrics)`."""

    @abc.abstractmethod
    def full_update(self, learner: LearnerT, batch: Batch, key: PRNGKeyArray) -> tuple[LearnerT, Losses]:
        """One gradient step on critics and policy: `(learner, metrics)`."""

    # What all of them do.

    @property
    def steps_per_iteration(self) -> int:
        return self.num_envs * self.config.unroll_length

    @property
    def updates_per_iteration(self) -> int:
        """Critic updates of one `learn`."""
        return self.config.grad_updates_per_step * self.config.unroll_length

    @property
    def num_random_steps(self) -> int:
        """Environment steps with uniformly random actions."""
        given = self.config.random_steps
        return self.config.learning_starts if given is None else given

    @property
    def rows_before_learning(self) -> int:
        """Steps of all environments before the first update."""
        return max(-(-self.config.learning_starts // self.num_envs), self.n_step + 1)

    @property
    def replay_bytes(self) -> int:
        return self.buffer.num_bytes

    def apply_gradients(
        self, params: _ParamsT, grads: _ParamsT, optimizer: optax.OptState, rate: Float[Array, ""] | float
    ) -> tuple[_ParamsT, optax.OptState]:
        """One gradient step: parameters and optimizer state after it."""
        return apply_gradients(self.optimizer, params, grads, optimizer, rate, self.axis_name)

    def normalize(
        self, normalizer: RunningStatisticsState, obs: Float[Array, "*batch observation_size"]
    ) -> Float[Array, "*batch observation_size"]:
        """Normalised and clipped observations."""
        return running_statistics.normalize(obs, normalizer, max_abs_value=self.config.observation_clip)

    def policy_params(self, state: OffPolicyState[LearnerT]) -> PolicyParams:
        return (state.normalizer, state.learner.policy)

    def with_policy(self, state: OffPolicyState[LearnerT], policy_params: PolicyParams) -> OffPolicyState[LearnerT]:
        normalizer, policy = policy_params
        return state.replace(normalizer=normalizer, learner=state.learner.replace(policy=policy))

    def policy(self, policy_params: PolicyParams, deterministic: bool = True) -> PolicyFn:
        normalizer, params = policy_params

        def act(obs: Float[Array, "*B observation_size"], key: PRNGKeyArray) -> Float[Array, "*B action_size"]:
            action = self.act(params, self.normalize(normalizer, obs), key, deterministic)
            return self.task.scale_action(action)

        return act

    def init(self, key: PRNGKeyArray) -> OffPolicyState[LearnerT]:
        learner_key, env_key, noise_key, key = jax.random.split(key, 4)
        learner = self.init_learner(learner_key)
        normalizer = networks.init_normalizer(self.task.observation_size)
        env = self.env.init(env_key)
        return OffPolicyState(
            env=env,
            evaluation=self.evaluator.init((normalizer, learner.policy), env.pool),
            key=key,
            iterations=jnp.zeros((), jnp.int32),
            learner=learner,
            critic_updates=jnp.zeros((), jnp.int32),
            normalizer=normalizer,
            return_scale=returns.init_return_scale(self.num_envs),
            replay=self.buffer.init(),
            noise_key=noise_key,
        )

    def collect(self, state: OffPolicyState[LearnerT]) -> tuple[OffPolicyState[LearnerT], tuple[Steps, Metrics]]:
        config = self.config
        key, pool_key = jax.random.split(state.key)
        step = state.iterations * config.unroll_length + jnp.arange(config.unroll_length)
        noise_keys = jax.vmap(jax.random.fold_in, (None, 0))(state.noise_key, step // self.noise_repeat)
        env, evaluation, scores = self.start_iteration(state, pool_key)
        actor = functools.partial(self._explore, state)
        env, evaluation, steps, metrics = rollout.unroll(
            self.env, self.evaluator, env, evaluation, actor, noise_keys, _keep
        )
        return state.replace(env=env, evaluation=evaluation, key=key), (steps, metrics | scores)

    def _explore(
        self, state: OffPolicyState[LearnerT], obs: Float[Array, "B observation_size"], key: PRNGKeyArray
    ) -> tuple[Float[Array, "B action_size"], Float[Array, "B action_size"]]:
        """Gymnasium's action and the networks'; uniformly random before learning starts."""
        is_random = state.iterations * float(self.steps_per_iteration) < self.num_random_steps
        explore_key, uniform_key = jax.random.split(key)
        chosen = self.explore(state.learner.policy, self.normalize(state.normalizer, obs), explore_key)
        uniform = jax.random.uniform(uniform_key, chosen.shape, minval=-1.0, maxval=1.0)
        action = jnp.where(is_random, uniform, chosen)
        return self.task.scale_action(action), action

    def learn(
        self, state: OffPolicyState[LearnerT], batch: tuple[Steps, Metrics]
    ) -> tuple[OffPolicyState[LearnerT], Metrics]:
        config = self.config
        steps, env_metrics = batch
        key, update_key = jax.random.split(state.key)
        normalizer = state.normalizer
        if config.normalize_observations:
            normalizer = networks.update_normalizer(normalizer, steps.observation, self.axis_name)
        remaining = remaining_fraction(state.iterations * float(self.steps_per_iteration), config.schedule_steps)
        discount = anneal_discount(config.discount, config.final_discount, remaining)
        ended = steps.terminated | steps.truncated
        return_scale = returns.update_return_scale(state.return_scale, steps.reward, ended, discount, self.axis_name)
        reward_scale = jnp.float32(config.reward_scale)
        if config.normalize_rewards:
            reward_scale *= returns.reward_multiplier(return_scale, config.normalized_return_max)
        replay = self.buffer.insert(state.replay, steps)
        rate_factor = schedule_factor(config.learning_rate_schedule, remaining)
        make_batch = functools.partial(Batch, reward_scale=reward_scale, rate_factor=rate_factor, remaining=remaining)
        update = functools.partial(self._train, make_batch, replay, normalizer, discount, update_key)
        train = jax.jit(update, inline=True)  # traced once for both branches
        can_learn = replay.rows >= self.rows_before_learning
        learner, metrics = jax.lax.cond(can_learn, train, functools.partial(_wait, train), state.learner)
        new_state = state.replace(
            learner=learner,
            critic_updates=state.critic_updates + jnp.where(can_learn, self.updates_per_iteration, 0),
            normalizer=normalizer,
            return_scale=return_scale,
            replay=replay,
            key=key,
            iterations=state.iterations + 1,
        )
        counts = {
            "critic_updates": jnp.float32(new_state.critic_updates),
            "replay_transitions": jnp.minimum(replay.rows, self.buffer.num_rows) * jnp.float32(self.num_envs),
            "reward_scale": reward_scale,
        }
        learned = {name: metric.only_if(can_learn) for name, metric in as_means(metrics).items()}
        return new_state, env_metrics | learned | as_means(counts)

    def _train(
        self,
        make_batch: functools.partial[Batch],
        replay: Replay,
        normalizer: RunningStatisticsState,
        discount: Float[Array, ""] | float,
        key: PRNGKeyArray,
        learner: LearnerT,
    ) -> tuple[LearnerT, Losses]:
        """All updates of an iteration: `policy_delay` critic updates at a time, the last of them with the policy's."""
        config = self.config

        def critic_update(learner, inputs):
            transitions, key = inputs
            return self.critic_update(learner, make_batch(transitions), key)[0], None

        def policy_period(learner, inputs):
            first = jax.tree.map(lambda x: x[:-1], inputs)
            learner, _ = jax.lax.scan(critic_update, learner, first)
            transitions, key = jax.tree.map(lambda x: x[-1], inputs)
            return self.full_update(learner, make_batch(transitions), key)

        # Sampled and normalized at once: on a GPU, small updates wait for the launch of their kernels.
        sample_key, key = jax.random.split(key)
        num_transitions = self.updates_per_iteration * config.batch_size
        sampled = self.buffer.sample(replay, sample_key, num_transitions, self.n_step, discount)
        sampled = sampled._replace(
            observation=self.normalize(normalizer, sampled.observation),
            next_observation=self.normalize(normalizer, sampled.next_observation),
        )
        periods = (self.updates_per_iteration // config.policy_delay, config.policy_delay)
        sampled = jax.tree.map(lambda x: x.reshape((*periods, config.batch_size, *x.shape[1:])), sampled)
        learner, metrics = jax.lax.scan(policy_period, learner, (sampled, jax.random.split(key, periods)))
        return learner, jax.tree.map(lambda x: x.mean(axis=0), metrics)


def _keep(step: rollout.Step) -> Steps:
    outcome = step.outcome
    return Steps(step.obs, step.extras, outcome.reward, outcome.terminated, outcome.truncated, outcome.obs)


def _wait(train: Callable[[LearnerT], tuple[LearnerT, Losses]], learner: LearnerT) -> tuple[LearnerT, Losses]:
    """The unchanged learner, and zeros for metrics, before learning starts."""
    shapes = jax.eval_shape(train, learner)[1]
    return learner, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def steps_of(seconds: float, dt: float) -> int:
    """Control steps that take about so long, at least one.

    Args:
        seconds: time, s.
        dt: time of a step, s.
    """
    return max(1, round(seconds / dt))
