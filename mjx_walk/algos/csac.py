"""Categorical soft actor-critic: SAC whose critics learn the return's distribution, by cross-entropy.

For thousands of copies. Sources: the categorical critic of C51 (Bellemare et al. 2017) in SAC with normalised rewards,
as SimbaV2 (Lee et al. 2025) and FlashSAC have it; policy and temperature stay Brax's.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.training.agents.sac.networks import SACNetworks

from mjx_walk.algos.off_policy import Learner, make_off_policy
from mjx_walk.algos.sac import SACConfig, make_sac_learner
from mjx_walk.common import networks
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm, Transition

Distributions = Callable[[Any, jax.Array, jax.Array], jax.Array]
"""`(critic params, obs, action) → log-probabilities of the atoms`, `[…, 2, num_atoms]`."""


@dataclasses.dataclass
class CSACConfig(SACConfig):
    """Settings of categorical SAC; the recipe of each task changes some of them."""

    name: str = setting("csac", choices=("csac",))
    num_atoms: int = setting(101, at_least=2)
    """Returns that the critics tell apart, evenly spaced from `-normalized_return_max` to `normalized_return_max`."""
    normalize_rewards: bool = True
    normalized_return_max: float | None = setting(5.0, above=0)


def make_csac(task: Task, num_envs: int, evaluation: EvaluationConfig, config: CSACConfig) -> Algorithm:
    """Build categorical SAC for a task; see `make_off_policy`.

    Raises:
        UserError: settings that do not go together.
    """
    return make_off_policy(task, num_envs, evaluation, config, make_csac_learner(task, config))


def make_csac_networks(task: Task, config: CSACConfig) -> tuple[SACNetworks, Distributions, jax.Array]:
    """Networks whose critics give expected returns, `[…, 2]`; what these are the means of; and the atoms.

    Raises:
        UserError: the returns have no bound.
    """
    if config.normalized_return_max is None:
        raise UserError("algo.normalized_return_max=null: csac needs a bound, the range of its atoms")
    atoms = jnp.linspace(-config.normalized_return_max, config.normalized_return_max, config.num_atoms)
    critics = networks.make_critics(2, config.num_atoms, task, config)

    def log_distributions(params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
        return jax.nn.log_softmax(critics.apply(None, params, obs, action))

    def values(_: Any, params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.exp(log_distributions(params, obs, action)) @ atoms

    nets = networks.make_sac_networks(task, config, dataclasses.replace(critics, apply=values))
    return nets, log_distributions, atoms


def make_csac_learner(task: Task, config: CSACConfig) -> Learner:
    """SAC's, but for the critics and their loss."""
    nets, log_distributions, atoms = make_csac_networks(task, config)
    policy_distribution = nets.parametric_action_distribution

    def make_critic_loss(reward_scale: jax.Array):
        def critic_loss(
            critic: Any, policy: Any, _: Any, target_critic: Any, alpha: jax.Array, data: Transition, key: jax.Array
        ) -> jax.Array:
            logits = nets.policy_network.apply(None, policy, data.next_observation)
            raw_action = policy_distribution.sample_no_postprocessing(logits, key)
            log_prob = policy_distribution.log_prob(logits, raw_action)
            next_action = policy_distribution.postprocess(raw_action)
            both = jnp.exp(log_distributions(target_critic, data.next_observation, next_action))
            lower = (both @ atoms).argmin(axis=-1)
            next_probs = jnp.take_along_axis(both, lower[:, None, None], axis=1)[:, 0]
            soft = atoms - (alpha * log_prob)[:, None]
            future = data.discount[:, None] * soft
            target = project(next_probs, (data.reward * reward_scale)[:, None] + future, atoms)
            log_probs = log_distributions(critic, data.observation, data.action)
            return -(target[:, None] * log_probs).sum(axis=(-2, -1)).mean()

        return critic_loss

    return make_sac_learner(task, config, nets, make_critic_loss)


def project(probs: jax.Array, positions: jax.Array, atoms: jax.Array) -> jax.Array:
    """Share the mass at each position among the two atoms beside it; what lies outside goes to the outermost.

    Args:
        probs: `[B, A]`.
        positions: `[B, A]`, where that mass lies.
        atoms: `[A]`, evenly spaced.

    Returns:
        Probabilities of the atoms, `[B, A]`, with the mean of what lay inside.
    """
    spacing = atoms[1] - atoms[0]
    positions = jnp.clip(positions, atoms[0], atoms[-1])
    # Every pair of a position and an atom: on a GPU faster than scattering, since it is never written to memory.
    share = jnp.clip(1.0 - jnp.abs(positions[:, None, :] - atoms[:, None]) / spacing, 0.0, 1.0)
    return (share * probs[:, None, :]).sum(axis=-1)
