"""Brax's networks for one task, and the observation normalizer."""

import dataclasses
import functools
import math
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.sac import networks as sac_networks
from brax.training.distribution import NormalDistribution, NormalTanhDistribution
from brax.training.networks import ACTIVATION
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.envs import TrainableTask
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Params, PyTree

__all__ = [
    "ACTIVATIONS",
    "MIN_OBSERVATION_STD",
    "OffPolicyNetworkConfig",
    "PPONetworkConfig",
    "init_normalizer",
    "make_critics",
    "make_deterministic_networks",
    "make_ppo_networks",
    "make_sac_networks",
    "update_normalizer",
]

ACTIVATIONS = tuple(name for name in ACTIVATION if name not in ("compact", "glu", "logsumexp", "one_hot"))
"""Names of activations. Brax's own list also has functions that change an array's shape or need more arguments."""

MIN_OBSERVATION_STD = 1e-4
"""Lower bound of an observation's std, so that near-constant ones such as a body's mass are not amplified."""


class PPONetworkConfig(Protocol):
    """Settings of PPO's networks; `OnPolicyConfig` documents them."""

    policy_hidden_layer_sizes: tuple[int, ...]
    value_hidden_layer_sizes: tuple[int, ...]
    activation: str
    distribution: str
    """`tanh_normal`: state-dependent std, squashed; `normal`: unbounded, std dependent or not."""
    init_noise_std: float
    state_dependent_std: bool
    min_log_std: float
    max_log_std: float
    observation_clip: float | None
    network_dtype: str


class OffPolicyNetworkConfig(Protocol):
    """Settings of a policy and critics; `OffPolicyConfig` documents them."""

    policy_hidden_layer_sizes: tuple[int, ...]
    critic_hidden_layer_sizes: tuple[int, ...]
    policy_layer_norm: bool
    critic_layer_norm: bool
    activation: str
    network_dtype: str


def make_ppo_networks(task: TrainableTask, config: PPONetworkConfig) -> ppo_networks.PPONetworks:
    """Policy and value network of Brax's PPO, for one task.

    Args:
        task: gives the sizes.
        config: settings of the networks.

    Raises:
        UserError: the bounds of the std exclude each other.
    """
    normal_only: dict[str, Any] = {}
    if config.distribution == "normal":
        normal_only = {
            "noise_std_type": "log",
            "init_noise_std": config.init_noise_std,
            "state_dependent_std": config.state_dependent_std,
            "mean_kernel_init_fn": functools.partial(jax.nn.initializers.variance_scaling, 1e-4, "fan_in", "uniform"),
        }
    nets = ppo_networks.make_ppo_networks(
        task.observation_size,
        task.action_size,
        preprocess_observations_fn=lambda obs, normalizer: running_statistics.normalize(
            obs, normalizer, max_abs_value=config.observation_clip
        ).astype(config.network_dtype),
        policy_hidden_layer_sizes=tuple(config.policy_hidden_layer_sizes),
        value_hidden_layer_sizes=tuple(config.value_hidden_layer_sizes),
        activation=ACTIVATION[config.activation],
        distribution_type=config.distribution,
        **normal_only,
    )
    nets = nets.replace(
        policy_network=_compute_in(config.network_dtype, nets.policy_network),
        value_network=_compute_in(config.network_dtype, nets.value_network),
    )
    if config.distribution == "normal":
        if config.min_log_std > config.max_log_std:
            raise UserError(f"algo.min_log_std={config.min_log_std} is above algo.max_log_std={config.max_log_std}")
        nets = nets.replace(parametric_action_distribution=_BoundedNormal(task.action_size, config))
    return nets


class _BoundedNormal(NormalDistribution):
    """Brax's normal distribution with a bounded std."""

    def __init__(self, event_size: int, config: PPONetworkConfig):
        super().__init__(event_size)
        self._std_bounds = math.exp(config.min_log_std), math.exp(config.max_log_std)

    def create_dist(self, parameters):
        mean, std = parameters
        return super().create_dist((mean, jnp.clip(std, *self._std_bounds)))


def make_sac_networks(
    task: TrainableTask, config: OffPolicyNetworkConfig, critics: brax_networks.FeedForwardNetwork | None = None
) -> sac_networks.SACNetworks:
    """Policy and critics of Brax's SAC, for one task, each of its own size, on normalized observations.

    Args:
        task: gives the sizes.
        config: settings of the networks.
        critics: instead of the usual two; they give `[…, num_critics]`.
    """
    distribution = NormalTanhDistribution(event_size=task.action_size)
    return sac_networks.SACNetworks(
        policy_network=_policy_network(distribution.param_size, task, config),
        q_network=critics or _scalar_critics(2, task, config),
        parametric_action_distribution=distribution,
    )


def make_deterministic_networks(
    task: TrainableTask, config: OffPolicyNetworkConfig, num_critics: int
) -> tuple[brax_networks.FeedForwardNetwork, brax_networks.FeedForwardNetwork]:
    """A policy whose outputs the caller squashes by tanh, and critics; settings as for `make_sac_networks`."""
    return _policy_network(task.action_size, task, config), _scalar_critics(num_critics, task, config)


def _policy_network(
    num_outputs: int, task: TrainableTask, config: OffPolicyNetworkConfig
) -> brax_networks.FeedForwardNetwork:
    network = brax_networks.make_policy_network(
        num_outputs,
        task.observation_size,
        preprocess_observations_fn=lambda obs, _: obs.astype(config.network_dtype),
        hidden_layer_sizes=tuple(config.policy_hidden_layer_sizes),
        activation=ACTIVATION[config.activation],
        layer_norm=config.policy_layer_norm,
    )
    return _compute_in(config.network_dtype, network)


def _scalar_critics(
    num_critics: int, task: TrainableTask, config: OffPolicyNetworkConfig
) -> brax_networks.FeedForwardNetwork:
    network = make_critics(num_critics, 1, task, config)
    return dataclasses.replace(network, apply=lambda *inputs: network.apply(*inputs)[..., 0])


def make_critics(
    num_critics: int, num_outputs: int, task: TrainableTask, config: OffPolicyNetworkConfig
) -> brax_networks.FeedForwardNetwork:
    """Brax's critics with stacked parameters: one batched product instead of several small ones.

    Inputs are padded with zeros to a multiple of eight, without which a GPU's tensor cores cannot read their rows.

    Args:
        num_critics: networks of the same shape.
        num_outputs: of each.
        task: gives the sizes.
        config: as for `make_sac_networks`.

    Returns:
        A network that gives `[…, num_critics, num_outputs]` for observations and actions.
    """
    critic = brax_networks.MLP(
        layer_sizes=(*config.critic_hidden_layer_sizes, num_outputs),
        activation=ACTIVATION[config.activation],
        layer_norm=config.critic_layer_norm,
    )
    padding = -(task.observation_size + task.action_size) % 8

    def init(key: PRNGKeyArray) -> Params:
        inputs = jnp.zeros((1, task.observation_size + task.action_size))
        params = jax.vmap(critic.init, (0, None))(jax.random.split(key, num_critics), inputs)
        first = params["params"]["hidden_0"]
        first["kernel"] = jnp.pad(first["kernel"], ((0, 0), (0, padding), (0, 0)))
        return params

    def apply(
        _: object,
        params: Params,
        obs: Float[Array, "*batch observation_size"],
        action: Float[Array, "*batch action_size"],
    ) -> Float[Array, "*batch num_critics num_outputs"]:
        inputs = jnp.concatenate([obs, action, jnp.zeros((*obs.shape[:-1], padding), obs.dtype)], axis=-1)
        return jax.vmap(critic.apply, (0, None), -2)(params, inputs.astype(config.network_dtype))

    return _compute_in(config.network_dtype, brax_networks.FeedForwardNetwork(init=init, apply=apply))


def _compute_in(dtype: str, network: brax_networks.FeedForwardNetwork) -> brax_networks.FeedForwardNetwork:
    """A network that computes in `dtype`; it casts its inputs itself, and parameters and results are float32."""

    def cast(tree: PyTree, dtype: DTypeLike) -> PyTree:
        return jax.tree.map(lambda x: x.astype(dtype), tree)

    def apply(normalizer: running_statistics.RunningStatisticsState | None, params: Params, *inputs: Array) -> PyTree:
        return cast(network.apply(normalizer, cast(params, dtype), *inputs), jnp.float32)

    return dataclasses.replace(network, apply=apply)


def init_normalizer(observation_size: int) -> running_statistics.RunningStatisticsState:
    """Running mean and std before the first observation."""
    return running_statistics.init_state(specs.Array((observation_size,), jnp.dtype("float32")))


def update_normalizer(
    normalizer: running_statistics.RunningStatisticsState,
    obs: Float[Array, "*batch observation_size"],
    axis_name: str | None = None,
) -> running_statistics.RunningStatisticsState:
    """Add observations, those of all devices, to the running statistics."""
    return running_statistics.update(normalizer, obs, std_min_value=MIN_OBSERVATION_STD, pmap_axis_name=axis_name)
