"""Categorical soft actor-critic: SAC whose critics learn the distribution of returns by cross-entropy.

Sources: the categorical critic of C51 (Bellemare et al. 2017) in SAC with normalized rewards, as in SimbaV2 (Lee et
al. 2025) and FlashSAC. Policy and temperature are Brax's.
"""

import dataclasses

import jax
import jax.numpy as jnp
from brax.training.agents.sac.networks import SACNetworks
from brax.training.networks import FeedForwardNetwork
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.algos.off_policy_state import Batch
from mjx_walk.algos.sac import SAC, SACConfig, SACState
from mjx_walk.common import networks
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import Losses, Params

__all__ = ["CSAC", "CSACConfig", "project"]


@dataclasses.dataclass
class CSACConfig(SACConfig):
    """Settings of categorical SAC."""

    name: str = setting("csac", choices=("csac",))
    num_atoms: int = setting(101, at_least=2, at_most=10_000)
    """Atoms of the return distribution, evenly spaced from `-normalized_return_max` to `normalized_return_max`; the
    latter is v_max in C51."""
    normalize_rewards: bool = True
    normalized_return_max: float | None = setting(5.0, above=0)


@dataclasses.dataclass(frozen=True, eq=False)
class CSAC(SAC):
    """SAC with categorical critics.

    Raises:
        UserError: the returns have no bound.
    """

    config: CSACConfig
    critics: FeedForwardNetwork = dataclasses.field(init=False, repr=False)
    """Logits of the atoms, `[…, 2, num_atoms]`."""
    atoms: Array = dataclasses.field(init=False, repr=False)
    """`[num_atoms] f32`, evenly spaced."""

    def make_networks(self) -> SACNetworks:
        """Policy, and critics that give expected returns, `[…, 2]`."""
        config = self.config
        if config.normalized_return_max is None:
            raise UserError("algo.normalized_return_max=null: csac needs a bound, the range of its atoms")
        bound = config.normalized_return_max
        self._set(
            atoms=jnp.linspace(-bound, bound, config.num_atoms),
            critics=networks.make_critics(2, config.num_atoms, self.task, config),
        )
        expected_returns = dataclasses.replace(self.critics, apply=self._expected_returns)
        return networks.make_sac_networks(self.task, config, expected_returns)

    def log_probs(
        self, critic: Params, obs: Float[Array, "N observation_size"], action: Float[Array, "N action_size"]
    ) -> Float[Array, "N 2 num_atoms"]:
        """Log-probabilities of the atoms of both critics."""
        return jax.nn.log_softmax(self.critics.apply(None, critic, obs, action))

    def _expected_returns(
        self, _: object, critic: Params, obs: Float[Array, "N observation_size"], action: Float[Array, "N action_size"]
    ) -> Float[Array, "N 2"]:
        return jnp.exp(self.log_probs(critic, obs, action)) @ self.atoms

    def critic_loss(
        self, critic: Params, learner: SACState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], Losses]:
        """The loss of the critics, and the target's mass on the two outermost atoms.

        `normalized_return_max` bounds the return without the entropy bonus. What the bonus adds beyond it goes to the
        outermost atoms.
        """
        data, distribution = batch.transitions, self.nets.parametric_action_distribution
        alpha = jnp.exp(learner.log_alpha)
        logits = self.nets.policy_network.apply(None, learner.policy, data.next_observation)
        raw_action = distribution.sample_no_postprocessing(logits, key)
        log_prob = distribution.log_prob(logits, raw_action)
        next_action = distribution.postprocess(raw_action)
        both = jnp.exp(self.log_probs(learner.target_critic, data.next_observation, next_action))
        lower = (both @ self.atoms).argmin(axis=-1)
        next_probs = jnp.take_along_axis(both, lower[:, None, None], axis=1)[:, 0]
        soft = self.atoms - (alpha * log_prob)[:, None]
        future = data.discount[:, None] * soft
        target = project(next_probs, (data.reward * batch.reward_scale)[:, None] + future, self.atoms)
        log_probs = self.log_probs(critic, data.observation, data.action)
        metrics = {"target_mass_lowest_atom": target[:, 0].mean(), "target_mass_highest_atom": target[:, -1].mean()}
        return -(target[:, None] * log_probs).sum(axis=(-2, -1)).mean(), metrics


def project(
    probs: Float[Array, "N A"], positions: Float[Array, "N A"], atoms: Float[Array, " A"]
) -> Float[Array, "N A"]:
    """Distribute the mass at each position over its two neighbouring atoms; mass outside goes to the outermost atoms.

    Args:
        probs: masses, which sum to 1.
        positions: where each of them lies.
        atoms: evenly spaced.

    Returns:
        Probabilities of the atoms. The mean is preserved where no mass lies outside.
    """
    spacing = atoms[1] - atoms[0]
    positions = jnp.clip(positions, atoms[0], atoms[-1])
    # Every pair of a position and an atom: on a GPU faster than scattering, since it is never written to memory.
    share = jnp.clip(1.0 - jnp.abs(positions[:, None, :] - atoms[:, None]) / spacing, 0.0, 1.0)
    return (share * probs[:, None, :]).sum(axis=-1)
