"""What wraps Brax's networks: the observation normalizer, and actions in Gymnasium's units."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.networks import ACTIVATION

from mjx_walk.envs import Task

MIN_OBSERVATION_STD = 1e-4
"""Observations that hardly vary (a body's mass) are not blown up beyond this."""


def make_ppo_networks(task: Task, config: Any) -> ppo_networks.PPONetworks:
    """Policy and value network of Brax's PPO, for one task.

    Args:
        task: gives the sizes.
        config: with `policy_hidden_layer_sizes`, `value_hidden_layer_sizes`, `activation`, `distribution`
            (`tanh_normal`: state-dependent std, squashed; `normal`: state-independent std, unbounded),
            `init_noise_std` and `observation_clip`.
    """
    normal_only: dict[str, Any] = {}
    if config.distribution == "normal":
        normal_only = {
            "noise_std_type": "log",
            "init_noise_std": config.init_noise_std,
            "mean_kernel_init_fn": functools.partial(jax.nn.initializers.variance_scaling, 1e-4, "fan_in", "uniform"),
        }
    return ppo_networks.make_ppo_networks(
        task.observation_size,
        task.action_size,
        preprocess_observations_fn=functools.partial(
            running_statistics.normalize, max_abs_value=config.observation_clip
        ),
        policy_hidden_layer_sizes=tuple(config.policy_hidden_layer_sizes),
        value_hidden_layer_sizes=tuple(config.value_hidden_layer_sizes),
        activation=ACTIVATION[config.activation],
        distribution_type=config.distribution,
        **normal_only,
    )


def init_normalizer(observation_size: int) -> running_statistics.RunningStatisticsState:
    """Running mean and std of observations, nothing seen yet."""
    return running_statistics.init_state(specs.Array((observation_size,), jnp.dtype("float32")))


def update_normalizer(
    normalizer: running_statistics.RunningStatisticsState, obs: jax.Array
) -> running_statistics.RunningStatisticsState:
    """Take `[…, observation_size]` observations into the running statistics."""
    return running_statistics.update(normalizer, obs, std_min_value=MIN_OBSERVATION_STD)


def to_env_action(task: Task, action: jax.Array) -> jax.Array:
    """From the networks' `[-1, 1]` to Gymnasium's units; an unbounded Gaussian's samples are clipped first."""
    center = (task.action_high + task.action_low) / 2
    return center + (task.action_high - task.action_low) / 2 * jnp.clip(action, -1.0, 1.0)
