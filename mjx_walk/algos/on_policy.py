"""What on-policy algorithms share: networks, and collecting trajectories whose time limits are bootstrapped through."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import flax
import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo import networks as brax_ppo_networks
from brax.training.networks import ACTIVATION

from mjx_walk.common import networks, returns, rollout
from mjx_walk.common.exploration import OrnsteinUhlenbeck
from mjx_walk.common.optimizers import make_adam
from mjx_walk.common.schedules import anneal
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig, InlineEvaluator
from mjx_walk.envs.vector_env import VectorEnv, VectorState
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Metrics, PolicyFn, Transition


@dataclasses.dataclass
class OnPolicyConfig:
    """Settings that all on-policy algorithms have."""

    unroll_length: int = setting(10, at_least=1)
    """Steps of one trajectory piece, over which advantages are estimated."""
    num_unrolls: int = setting(4, at_least=1)
    """Pieces of every copy in one batch."""
    normalizer_warmup_steps_per_env: int = setting(16, at_least=0)
    """Of each copy, at the start: batches of these only tell the scale of observations and rewards. Ten are too few on
    Humanoid, which falls in 24 under random actions: scaled by the first ten, the positions of the next ten are two
    standard deviations away, and learning starts with a KL of 3 to 13."""
    learning_rate: float = setting(3e-4, above=0)
    learning_rate_schedule: str = setting("constant", choices=("constant", "linear", "adaptive_kl"))
    """`linear`: to zero over `schedule_steps`; `adaptive_kl`: the policy's is adapted after each batch so that it has
    moved by about `target_kl` at its end, and both are annealed as well."""
    target_kl: float = setting(0.01, above=0)
    schedule_steps: int = setting(100_000_000, at_least=1)
    """Environment steps over which schedules run. Fixed, so that stopping early does not change the path."""
    max_policy_grad_norm: float = setting(1.0, above=0)
    max_value_grad_norm: float | None = setting(None, above=0)
    """Unset, `max_policy_grad_norm` clips policy and value together, as Brax does."""
    discount: float = setting(0.97, at_least=0, at_most=1)
    gae_lambda: float = setting(0.95, at_least=0, at_most=1)
    entropy_coef: float = setting(1e-3, at_least=0)
    entropy_schedule: str = setting("constant", choices=("constant", "linear"))
    """`linear`: to zero over `schedule_steps`."""
    value_loss_coef: float = setting(0.5, above=0)
    """Of the squared error; PPO's loss, which is Brax's, halves it once more."""
    reward_scale: float = setting(0.1, above=0)
    normalize_rewards: bool = False
    """Divide rewards by the running std of the discounted return, before `reward_scale`."""
    normalize_advantages: bool = True
    observation_clip: float | None = setting(10.0, above=0)
    """Bound of normalised observations."""
    policy_hidden_layer_sizes: tuple[int, ...] = setting((256, 256, 128), at_least=1)
    value_hidden_layer_sizes: tuple[int, ...] = setting((256, 256, 256, 256), at_least=1)
    activation: str = setting("swish", choices=tuple(ACTIVATION))
    network_dtype: str = setting("float32", choices=("float32", "bfloat16"))
    """That the networks compute in. Parameters, losses and optimizers are float32."""
    distribution: str = setting("tanh_normal", choices=("tanh_normal", "normal"))
    """Squashed, with a std that depends on the state, or unbounded; the next four are for the latter."""
    init_noise_std: float = setting(1.0, above=0)
    """Of a std that does not depend on the state."""
    state_dependent_std: bool = False
    min_log_std: float = setting(-20.0, at_least=-80, at_most=80)
    max_log_std: float = setting(2.0, at_least=-80, at_most=80)
    """The same as `min_log_std` for a std that does not learn."""
    init_at_random_episode_step: bool = True


class OnPolicyState(flax.struct.PyTreeNode):
    """Everything that influences the next update."""

    params: ppo_losses.PPONetworkParams
    optimizer: optax.OptState
    learning_rate: jax.Array
    """The policy's, which is constant unless it is adapted."""
    normalizer: RunningStatisticsState
    return_scale: returns.ReturnScale
    env: VectorState
    noise: jax.Array | tuple[()]
    """Of exploration, where it is correlated in time, `[B, action_size]`."""
    key: jax.Array
    iterations: jax.Array
    """`[] i32`: updates done."""


class OnPolicyBatch(flax.struct.PyTreeNode):
    """What one `collect` hands to `learn`; N pieces of T steps."""

    transitions: Transition
    """`[N, T, …]`. What Brax's PPO loss does not read is left out: `action` is empty (the raw action is in `extras`),
    and `next_observation` holds the last step's only, `[N, 1, …]`."""
    rewards: jax.Array
    """`[T·U, B]`, as the environment gave them, in their order; U pieces of each copy."""
    ended: jax.Array
    """`[T·U, B] bool`: an episode ended at this step."""
    reward_scale: jax.Array
    stats: Metrics


class OnPolicyGround(NamedTuple):
    """What an on-policy algorithm adds its `learn` to; the fields of `Algorithm` are those of `Algorithm`."""

    nets: brax_ppo_networks.PPONetworks
    optimizer: optax.GradientTransformation
    """Without the learning rate; see `optimizers.apply_gradients`."""
    init: Callable[[jax.Array], OnPolicyState]
    collect: Callable[[OnPolicyState], tuple[OnPolicyState, OnPolicyBatch]]
    policy_params: Callable[[OnPolicyState], Any]
    policy: Callable[..., PolicyFn]
    steps_per_iteration: int
    num_warmup_batches: int
    """The first ones, which give the scale of observations and rewards and are not learned from."""
    remaining: Callable[[OnPolicyState], jax.Array]
    """The share of the schedules that is left."""


def make_on_policy(
    task: Task,
    num_envs: int,
    evaluation: EvaluationConfig,
    config: OnPolicyConfig,
    has_value: bool = True,
    exploration: OrnsteinUhlenbeck | None = None,
) -> OnPolicyGround:
    """Build all but `learn`.

    Args:
        task: the unbatched environment.
        num_envs: copies that learn.
        evaluation: of the policy beside them.
        config: settings.
        has_value: whether there is a value network. With one, time limits are bootstrapped through, and a truncated
            step reaches `learn` as a terminated one; without, as `truncation`.
        exploration: added to the actions that the policy draws; its probability is left out of account.
    """
    nets = networks.make_ppo_networks(task, config)

    def policy(policy_params, deterministic: bool = True):
        act = brax_ppo_networks.make_inference_fn(nets)(policy_params, deterministic=deterministic)
        return lambda obs, key: networks.to_env_action(task, act(obs, key)[0])

    def policy_params(state: OnPolicyState) -> Any:
        return (state.normalizer, state.params.policy)

    steps_per_iteration = num_envs * config.unroll_length * config.num_unrolls
    evaluator = InlineEvaluator(task, num_envs, evaluation, policy, steps_per_iteration)
    env = VectorEnv(task, num_envs, evaluator, config.init_at_random_episode_step)
    optimizer = _make_optimizer(config)

    def init(key: jax.Array) -> OnPolicyState:
        policy_key, value_key, env_key, key = jax.random.split(key, 4)
        params = ppo_losses.PPONetworkParams(
            policy=nets.policy_network.init(policy_key),
            value=nets.value_network.init(value_key) if has_value else {},
        )
        normalizer = networks.init_normalizer(task.observation_size)
        return OnPolicyState(
            params=params,
            optimizer=optimizer.init(params),
            learning_rate=jnp.float32(config.learning_rate),
            normalizer=normalizer,
            return_scale=returns.init_return_scale(num_envs),
            env=env.init(env_key, (normalizer, params.policy)),
            noise=exploration.init(num_envs, task.action_size) if exploration else (),
            key=key,
            iterations=jnp.zeros((), jnp.int32),
        )

    def collect(state: OnPolicyState) -> tuple[OnPolicyState, OnPolicyBatch]:
        key, pool_key, run_key = jax.random.split(state.key, 3)
        sample = brax_ppo_networks.make_inference_fn(nets)((state.normalizer, state.params.policy))
        reward_scale = jnp.float32(config.reward_scale)
        if config.normalize_rewards:
            reward_scale *= returns.reward_multiplier(state.return_scale)

        def actor(obs, inputs):
            key, noise = inputs
            action, extras = sample(obs, key)
            return networks.to_env_action(task, action + noise), extras

        def lost_value(outcome, truncated):
            """Values of observations that a time limit cut off; of one seed, computed only where there are any."""
            return jax.lax.cond(
                truncated.any(),
                lambda obs: nets.value_network.apply(state.normalizer, state.params.value, obs),
                lambda obs: jnp.zeros(obs.shape[0], jnp.float32),
                outcome.obs,
            )

        def keep(step: rollout.Step):
            outcome = step.outcome
            truncated = outcome.truncated & ~outcome.terminated
            reward, terminated = outcome.reward, outcome.terminated
            if has_value:
                value = lost_value(outcome, truncated)
                reward = returns.bootstrap_truncated(reward, truncated, value, config.discount, reward_scale)
                terminated, truncated = terminated | truncated, jnp.zeros_like(truncated)
            transition = Transition(
                observation=step.obs,
                action=(),
                reward=reward,
                discount=1.0 - jnp.float32(terminated),
                next_observation=(),
                extras={"policy_extras": step.extras, "state_extras": {"truncation": jnp.float32(truncated)}},
            )
            return transition, outcome.reward, outcome.terminated | outcome.truncated

        def piece(carry, key):
            env_state, noise = carry
            noises = jnp.zeros(config.unroll_length)
            if exploration:
                key, noise_key = jax.random.split(key)
                noises = exploration.sequence(noise, noise_key, config.unroll_length)
                noise = noises[-1]
            keys = jax.random.split(key, config.unroll_length)
            env_state, kept, stats = rollout.unroll(env, env_state, actor, (keys, noises), keep)
            return (env_state, noise), (*kept, env_state.env.obs, stats)

        env_state, scores = env.renew(state.env, pool_key, policy_params(state), state.iterations)
        keys = jax.random.split(run_key, config.num_unrolls)
        carry = (env_state, state.noise)
        (env_state, noise), (transitions, reward, done, last_obs, stats) = jax.lax.scan(piece, carry, keys)
        # Where an episode ended at a piece's last step, last_obs belongs to the next one: its discount is 0.
        transitions = jax.tree.map(_pieces_first, transitions)
        transitions = transitions._replace(next_observation=last_obs.reshape((-1, 1, last_obs.shape[-1])))
        batch = OnPolicyBatch(
            transitions=transitions,
            rewards=reward.reshape((-1, num_envs)),
            ended=done.reshape((-1, num_envs)),
            reward_scale=reward_scale,
            stats=jax.tree.map(lambda x: x.sum(0), stats) | scores,
        )
        return state.replace(env=env_state, noise=noise, key=key), batch

    def remaining(state: OnPolicyState) -> jax.Array:
        return anneal(state.iterations * float(steps_per_iteration), config.schedule_steps)

    return OnPolicyGround(
        nets,
        optimizer,
        init,
        collect,
        policy_params,
        policy,
        steps_per_iteration,
        math.ceil(config.normalizer_warmup_steps_per_env / (config.unroll_length * config.num_unrolls)),
        remaining,
    )


def _pieces_first(x: jax.Array) -> jax.Array:
    """`[U, T, B, …]` to `[U·B, T, …]`."""
    x = jnp.swapaxes(x, 1, 2)
    return x.reshape((-1, *x.shape[2:]))


def _make_optimizer(config: OnPolicyConfig) -> optax.GradientTransformation:
    if config.max_value_grad_norm is None:
        return make_adam(config.max_policy_grad_norm)
    parts = {"policy": make_adam(config.max_policy_grad_norm), "value": make_adam(config.max_value_grad_norm)}
    return optax.partition(parts, ppo_losses.PPONetworkParams(policy="policy", value="value"))
