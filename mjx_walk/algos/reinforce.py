"""REINFORCE (Williams 1992) for many copies: the policy gradient on returns as they came, without a value network."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_walk import returns
from mjx_walk.envs import Task
from mjx_walk.errors import UserError
from mjx_walk.live_evaluation import EvaluationConfig
from mjx_walk.on_policy import OnPolicyBatch, OnPolicyState, make_on_policy
from mjx_walk.policy_gradient import (
    PolicyGradientConfig,
    check_minibatches,
    learn_once,
    policy_gradient_loss,
    sampled_kl,
)
from mjx_walk.settings import setting
from mjx_walk.types import Algorithm, Metrics


@dataclasses.dataclass
class REINFORCEConfig(PolicyGradientConfig):
    """Settings of REINFORCE; the recipe of each task changes some of them. Those for advantages and values do nothing
    here."""

    name: str = setting("reinforce", choices=("reinforce",))
    unroll_length: int = setting(256, at_least=1)
    max_unseen: float = setting(0.05, above=0, at_most=1)
    """A step is learned from if its piece goes on until what follows counts at most this much."""


def make_reinforce(task: Task, num_envs: int, evaluation: EvaluationConfig, config: REINFORCEConfig) -> Algorithm:
    """Build REINFORCE for a task.

    Deviation: a copy does not wait for the others' episodes to end. A batch is a piece of `unroll_length` steps, of
    which the first are learned from: those after which it goes on until what follows is discounted away (`max_unseen`).
    Whether a step's episode ended within the piece makes no difference, or falls would be learned from more often than
    what prevents them.

    Args:
        task: the unbatched environment.
        num_envs: copies that learn.
        evaluation: of the policy beside them.
        config: settings.

    Raises:
        UserError: see `check_minibatches`; or the pieces are too short to learn from.
    """
    unseen_after_piece = [config.discount ** (config.unroll_length - step) for step in range(config.unroll_length)]
    num_learned = sum(unseen <= config.max_unseen for unseen in unseen_after_piece)
    if num_learned == 0:
        raise UserError(
            f"algo.unroll_length={config.unroll_length}: at its first step, what follows a piece counts "
            f"{unseen_after_piece[0]:.2f}, above algo.max_unseen={config.max_unseen}; "
            "lengthen it, or lower algo.discount"
        )
    check_minibatches(num_envs, config)
    ground = make_on_policy(task, num_envs, evaluation, config, has_value=False)
    distribution = ground.nets.parametric_action_distribution

    def loss(params, normalizer, data, entropy_cost, key):
        """`data`: transitions, normalised returns and weights, `[N, T, …]`."""
        transitions, advantage, weight = data
        logits = ground.nets.policy_network.apply(normalizer, params.policy, transitions.observation)
        log_prob = distribution.log_prob(logits, transitions.extras["policy_extras"]["raw_action"])
        entropy = distribution.entropy(logits, key).mean()
        acted_log_prob = transitions.extras["policy_extras"]["log_prob"]
        losses = policy_gradient_loss(log_prob, acted_log_prob, advantage)
        policy_loss = (weight * losses).sum() / jnp.maximum(weight.sum(), 1.0)
        kl = sampled_kl(log_prob, acted_log_prob)
        return policy_loss - entropy_cost * entropy, {"policy_loss": policy_loss, "entropy": entropy, "kl": kl}

    def learn(state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        transitions = batch.transitions._replace(next_observation=())
        return_to_go, unseen = returns.returns_to_go(
            transitions.reward.T,
            transitions.discount.T == 0.0,
            transitions.extras["state_extras"]["truncation"].T > 0.0,
            config.discount,
        )
        # Of these steps, only those before a time limit can have too much unseen.
        weight = jnp.float32(config.max_unseen >= unseen.T)
        kept = jax.tree.map(lambda x: x[:, :num_learned], (transitions, return_to_go.T * batch.reward_scale, weight))
        transitions, return_to_go, weight = kept
        data = (transitions, _normalize(return_to_go, weight), weight)
        new_state, metrics = learn_once(ground, config, state, batch, data, loss)
        return new_state, metrics | {"learned_from": weight.mean() * num_learned / config.unroll_length}

    return Algorithm(ground.init, ground.collect, learn, ground.policy_params, ground.policy, ground.steps_per_update)


def _normalize(values: jax.Array, weight: jax.Array) -> jax.Array:
    """To mean 0 and std 1 over what counts."""
    total = jnp.maximum(weight.sum(), 1.0)
    centred = values - (weight * values).sum() / total
    return centred / jnp.sqrt((weight * centred**2).sum() / total + 1e-8)
