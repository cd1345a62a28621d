"""Base of PPO, A2C and REINFORCE: networks, rollouts with bootstrapped time limits, and the end of an update."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import ClassVar, TypeVar

import flax
import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as brax_ppo_networks
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray, Shaped

from mjx_walk.algos.base import Algorithm, TrainState
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.common import networks, returns, rollout
from mjx_walk.common.brax_losses import PolicyExtras, PPOParams, on_policy_transition
from mjx_walk.common.exploration import Exploration, NoExploration
from mjx_walk.common.optimizers import adapt_rate, apply_gradients, make_adam, remaining_fraction, schedule_factor
from mjx_walk.utils import collectives
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PER_DEVICE, RESTARTS, Metrics, PolicyFn, PolicyParams, Transition

__all__ = ["OnPolicyAlgorithm", "OnPolicyBatch", "OnPolicyState", "require_several_gradient_steps"]

_OnPolicyConfigT = TypeVar("_OnPolicyConfigT", bound=OnPolicyConfig)


class OnPolicyState(TrainState):
    """State of an on-policy algorithm."""

    params: PPOParams
    optimizer: optax.OptState = flax.struct.field(metadata=RESTARTS)
    learning_rate: Array = flax.struct.field(metadata=RESTARTS)
    """`[] f32`: of the policy; constant unless it adapts to the KL."""
    normalizer: RunningStatisticsState
    return_scale: returns.ReturnScale
    exploration: Array | tuple[()] = flax.struct.field(metadata=PER_DEVICE)
    """State of the exploration noise; empty without noise."""


class OnPolicyBatch(flax.struct.PyTreeNode):
    """Batch that one `collect` hands to `learn`: N = U·B unrolls of T steps."""

    transitions: Transition
    """`[N, T, …]`. What Brax's PPO loss does not read is left out: `action` is empty (the raw action is in `extras`),
    and `next_observation` holds the last step's only, `[N, 1, …]`."""
    rewards: Array
    """`[T·U, B]`, as the environment gave them, in chronological order."""
    ended: Array
    """`[T·U, B] bool`: an episode ended at this step."""
    reward_scale: Array
    metrics: Metrics


@dataclasses.dataclass(frozen=True, eq=False)
class OnPolicyAlgorithm(Algorithm[OnPolicyState, OnPolicyBatch, _OnPolicyConfigT]):
    """Collects unrolls of the present policy. Subclasses define `update`.

    The first batches only measure the scale of observations and rewards. Without that scale the policy that learns
    would differ from the one that acted: on Walker2d by a KL of 6 to 13.
    """

    has_value: ClassVar[bool] = True
    """Whether there is a value network. With one, time limits are bootstrapped through, and `update` sees a truncated
    step as a terminated one; without, it sees `truncation`."""

    nets: brax_ppo_networks.PPONetworks = dataclasses.field(init=False, repr=False)
    optimizer: optax.GradientTransformation = dataclasses.field(init=False, repr=False)
    exploration: Exploration = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(
            nets=networks.make_ppo_networks(self.task, self.config),
            optimizer=_make_optimizer(self.config),
            exploration=self.make_exploration(),
        )

    def make_exploration(self) -> Exploration:
        """Noise added to the actions that the policy samples; their log-probabilities leave it out."""
        return NoExploration()

    @property
    def steps_per_iteration(self) -> int:
        return self.num_envs * self.config.unroll_length * self.config.num_unrolls

    @property
    def num_warmup_batches(self) -> int:
        """First batches, which set the scale of observations and rewards, and are not learned from."""
        steps = self.config.unroll_length * self.config.num_unrolls
        return math.ceil(self.config.normalizer_warmup_steps_per_env / steps)

    def policy_params(self, state: OnPolicyState) -> PolicyParams:
        return (state.normalizer, state.params.policy)

    def with_policy(self, state: OnPolicyState, policy_params: PolicyParams) -> OnPolicyState:
        normalizer, policy = policy_params
        return state.replace(normalizer=normalizer, params=state.params.replace(policy=policy))

    def policy(self, policy_params: PolicyParams, deterministic: bool = True) -> PolicyFn:
        act = brax_ppo_networks.make_inference_fn(self.nets)(policy_params, deterministic=deterministic)
        return lambda obs, key: self.task.scale_action(act(obs, key)[0])

    def init(self, key: PRNGKeyArray) -> OnPolicyState:
        policy_key, value_key, env_key, key = jax.random.split(key, 4)
        params = PPOParams(
            policy=self.nets.policy_network.init(policy_key),
            value=self.nets.value_network.init(value_key) if self.has_value else {},
        )
        normalizer = networks.init_normalizer(self.task.observation_size)
        env = self.env.init(env_key)
        return OnPolicyState(
            env=env,
            evaluation=self.evaluator.init((normalizer, params.policy), env.pool),
            key=key,
            iterations=jnp.zeros((), jnp.int32),
            params=params,
            optimizer=self.optimizer.init(params),
            learning_rate=jnp.float32(self.config.learning_rate),
            normalizer=normalizer,
            return_scale=returns.init_return_scale(self.num_envs),
            exploration=self.exploration.init(self.num_envs, self.task.action_size),
        )

    def collect(self, state: OnPolicyState) -> tuple[OnPolicyState, OnPolicyBatch]:
        config = self.config
        key, pool_key, run_key = jax.random.split(state.key, 3)
        reward_scale = self.reward_scale(state)
        sample = brax_ppo_networks.make_inference_fn(self.nets)(self.policy_params(state))
        actor = functools.partial(self._act, sample)
        keep = functools.partial(self._keep, state, reward_scale)

        def unroll(carry, key):
            env, evaluation, exploration = carry
            exploration, noise, key = self.exploration.unroll(exploration, key, config.unroll_length)
            inputs = (jax.random.split(key, config.unroll_length), noise)
            env, evaluation, kept, metrics = rollout.unroll(
                self.env, self.evaluator, env, evaluation, actor, inputs, keep
            )
            return (env, evaluation, exploration), (*kept, env.env.obs, metrics)

        env, evaluation, scores = self.start_iteration(state, pool_key)
        carry = (env, evaluation, state.exploration)
        (env, evaluation, exploration), (transitions, reward, done, last_obs, metrics) = jax.lax.scan(
            unroll, carry, jax.random.split(run_key, config.num_unrolls)
        )
        # If an episode ends at the last step of an unroll, last_obs starts the next one. Its discount is 0.
        transitions = jax.tree.map(_unrolls_first, transitions)
        transitions = transitions._replace(next_observation=last_obs.reshape((-1, 1, last_obs.shape[-1])))
        batch = OnPolicyBatch(
            transitions=transitions,
            rewards=reward.reshape((-1, self.num_envs)),
            ended=done.reshape((-1, self.num_envs)),
            reward_scale=reward_scale,
            metrics=jax.tree.map(lambda x: x.sum(0), metrics) | scores,
        )
        return state.replace(env=env, evaluation=evaluation, exploration=exploration, key=key), batch

    def reward_scale(self, state: OnPolicyState) -> Float[Array, ""]:
        """The factor of the rewards."""
        scale = jnp.float32(self.config.reward_scale)
        return scale * returns.reward_multiplier(state.return_scale) if self.config.normalize_rewards else scale

    def _act(
        self,
        sample: Callable[[Array, PRNGKeyArray], tuple[Array, PolicyExtras]],
        obs: Float[Array, "B observation_size"],
        inputs: tuple[PRNGKeyArray, Float[Array, "B action_size"] | Float[Array, ""]],
    ) -> tuple[Float[Array, "B action_size"], PolicyExtras]:
        """Gymnasium's action, with exploration noise, and what the loss needs of the sample."""
        key, noise = inputs
        action, extras = sample(obs, key)
        return self.task.scale_action(action + noise), extras

    def _keep(
        self, state: OnPolicyState, reward_scale: Float[Array, ""], step: rollout.Step
    ) -> tuple[Transition, Float[Array, " B"], Bool[Array, " B"]]:
        """The transition to learn from; the reward; and whether the episode ended."""
        outcome = step.outcome
        truncated = outcome.truncated & ~outcome.terminated
        reward, terminated = outcome.reward, outcome.terminated
        if self.has_value:
            value = self._lost_value(state, outcome.obs, truncated)
            reward = returns.bootstrap_truncated(reward, truncated, value, self.config.discount, reward_scale)
            terminated, truncated = terminated | truncated, jnp.zeros_like(truncated)
        transition = on_policy_transition(step.obs, reward, terminated, truncated, step.extras)
        return transition, outcome.reward, outcome.terminated | outcome.truncated

    def _lost_value(
        self, state: OnPolicyState, obs: Float[Array, "B observation_size"], truncated: Bool[Array, " B"]
    ) -> Float[Array, " B"]:
        """Values of the observations that a time limit cut off; computed only in steps that have any."""
        return jax.lax.cond(
            truncated.any(),
            lambda obs: self.nets.value_network.apply(state.normalizer, state.params.value, obs),
            lambda obs: jnp.zeros(obs.shape[0], jnp.float32),
            obs,
        )

    def update(self, state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        """Learn from a batch: `(state, batch) → (state, metrics)`."""
        raise NotImplementedError

    def learn(self, state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        learned, metrics = self.update(state, batch)
        is_warmup = state.iterations < self.num_warmup_batches
        old = (state.params, state.optimizer, state.learning_rate)
        new = (learned.params, learned.optimizer, learned.learning_rate)
        kept = jax.tree.map(lambda old, new: jnp.where(is_warmup, old, new), old, new)
        known = {name: metric.only_if(~is_warmup) for name, metric in metrics.items() if name not in batch.metrics}
        return learned.replace(params=kept[0], optimizer=kept[1], learning_rate=kept[2]), metrics | known

    def remaining(self, state: OnPolicyState) -> Float[Array, ""]:
        """The fraction of the schedules that is left."""
        return remaining_fraction(state.iterations * float(self.steps_per_iteration), self.config.schedule_steps)

    def learning_rates(self, state: OnPolicyState, remaining: Float[Array, ""]) -> PPOParams:
        """Learning rates of policy and value network."""
        factor = schedule_factor(self.config.learning_rate_schedule, remaining)
        return PPOParams(policy=state.learning_rate * factor, value=self.config.learning_rate * factor)

    def apply_gradients(
        self, params: PPOParams, grads: PPOParams, optimizer: optax.OptState, rates: PPOParams
    ) -> tuple[PPOParams, optax.OptState]:
        """One gradient step on policy and value network."""
        return apply_gradients(self.optimizer, params, grads, optimizer, rates, self.axis_name)

    def update_normalizer(self, state: OnPolicyState, batch: OnPolicyBatch) -> RunningStatisticsState:
        """The normalizer with the observations of a batch added."""
        return networks.update_normalizer(state.normalizer, batch.transitions.observation, self.axis_name)

    def finish_update(
        self,
        state: OnPolicyState,
        batch: OnPolicyBatch,
        params: PPOParams,
        optimizer: optax.OptState,
        normalizer: RunningStatisticsState,
        kl: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> OnPolicyState:
        """The state after an update. A learning rate under `adaptive_kl` follows the KL at the end of the update."""
        rate = state.learning_rate
        if self.config.learning_rate_schedule == "adaptive_kl":
            rate = adapt_rate(rate, collectives.mean(kl, self.axis_name), self.config.target_kl)
        return state.replace(
            params=params,
            optimizer=optimizer,
            learning_rate=rate,
            normalizer=normalizer,
            return_scale=returns.update_return_scale(
                state.return_scale, batch.rewards, batch.ended, self.config.discount, self.axis_name
            ),
            key=key,
            iterations=state.iterations + 1,
        )


def _unrolls_first(x: Shaped[Array, "U T B *rest"]) -> Shaped[Array, "U*B T *rest"]:
    """Merge unrolls and environments into one leading axis, before the steps."""
    x = jnp.swapaxes(x, 1, 2)
    return x.reshape((-1, *x.shape[2:]))


def _make_optimizer(config: OnPolicyConfig) -> optax.GradientTransformation:
    """Adam for policy and value network, with one gradient clip for both or one for each."""
    if config.max_value_grad_norm is None:
        return make_adam(config.max_policy_grad_norm)
    parts = {"policy": make_adam(config.max_policy_grad_norm), "value": make_adam(config.max_value_grad_norm)}
    return optax.partition(parts, PPOParams(policy="policy", value="value"))


def require_several_gradient_steps(config: OnPolicyConfig, num_gradient_steps: int) -> None:
    """Check that a learning rate that adapts to the KL has a KL to adapt to.

    Raises:
        UserError: the only gradient step of a batch starts where the policy has not moved.
    """
    if config.learning_rate_schedule == "adaptive_kl" and num_gradient_steps == 1:
        raise UserError("algo.learning_rate_schedule=adaptive_kl needs algo.num_minibatches of 2 or more")
