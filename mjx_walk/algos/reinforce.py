"""REINFORCE (Williams 1992) for many copies: the policy gradient on returns as they came, without a value network."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from mjx_walk.algos.on_policy import OnPolicyBatch, OnPolicyState, make_on_policy
from mjx_walk.algos.on_policy_update import make_algorithm
from mjx_walk.algos.policy_gradient import PolicyGradientConfig, Samples, check_minibatches, learn_once, normalize
from mjx_walk.common import returns
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm, Metrics


@dataclasses.dataclass
class REINFORCEConfig(PolicyGradientConfig):
    """Settings of REINFORCE; the recipe of each task changes some of them. Those for advantages and values do nothing
    here."""

    name: str = setting("reinforce", choices=("reinforce",))
    unroll_length: int = setting(256, at_least=1)
    max_tail_discount: float = setting(0.05, above=0, at_most=1)
    """A step is learned from if its piece goes on until what follows counts at most this much."""
    baseline: str = setting("linear", choices=("mean", "linear"))
    """What returns are compared with: the batch's mean, or what a linear fit to the batch expects of an observation."""


def make_reinforce(task: Task, num_envs: int, evaluation: EvaluationConfig, config: REINFORCEConfig) -> Algorithm:
    """Build REINFORCE for a task.

    Deviation: a copy does not wait for the others' episodes to end. A batch is a piece of `unroll_length` steps, of
    which the first are learned from: those after which it goes on until what follows is discounted away
    (`max_tail_discount`). Whether a step's episode ended within the piece makes no difference, or falls would be
    learned from more often than
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
    num_learned = sum(unseen <= config.max_tail_discount for unseen in unseen_after_piece)
    if num_learned == 0:
        raise UserError(
            f"algo.unroll_length={config.unroll_length}: at its first step, what follows a piece counts "
            f"{unseen_after_piece[0]:.2f}, above algo.max_tail_discount={config.max_tail_discount}; "
            "lengthen it, or lower algo.discount"
        )
    check_minibatches(num_envs * config.num_unrolls * num_learned, config)
    ground = make_on_policy(task, num_envs, evaluation, config, has_value=False)

    def no_value_loss(*_) -> tuple[jax.Array, Metrics]:
        return jnp.float32(0.0), {}

    def learn(state: OnPolicyState, batch: OnPolicyBatch) -> tuple[OnPolicyState, Metrics]:
        data = batch.transitions
        return_to_go, unseen = returns.returns_to_go(
            data.reward.T,
            data.discount.T == 0.0,
            data.extras["state_extras"]["truncation"].T > 0.0,
            config.discount,
        )
        # Of these steps, only those before a time limit can have too much unseen.
        weight = jnp.float32(config.max_tail_discount >= unseen.T[:, :num_learned])
        advantage, obs = return_to_go.T[:, :num_learned], data.observation[:, :num_learned]
        advantage = normalize(advantage, weight)
        if config.baseline == "linear":
            advantage = normalize(advantage - linear_fit(obs, advantage, weight), weight)
        acted = jax.tree.map(lambda x: x[:, :num_learned], data.extras["policy_extras"])
        samples = Samples(obs, acted["raw_action"], acted["log_prob"], advantage, weight, target=())
        new_state, metrics = learn_once(ground, config, state, batch, samples, no_value_loss)
        return new_state, metrics | {"learned_from": weight.mean() * num_learned / config.unroll_length}

    return make_algorithm(ground, learn)


_LARGEST = 5.0
"""Of features in the fit, in standard deviations, so that a few do not rule it."""
_RIDGE = 1e-2
"""Small beside the features' variance of 1, and enough for features that say the same in 32-bit floats."""


def linear_fit(obs: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """What a least-squares fit on observations and their squares expects the target to be.

    Source: the baseline of REINFORCE in Duan et al. 2016, "Benchmarking deep reinforcement learning for continuous
    control". Deviations: no powers of time, since nothing in these tasks depends on it; fitted to the batch itself.

    Args:
        obs: `[N, T, observation_size]`, unnormalised.
        target: `[N, T]`, of mean 0.
        weight: `[N, T]`, 0 where a target does not count.

    Returns:
        `[N, T]`.
    """
    linear = standardize(obs)
    features = jnp.concatenate([linear, standardize(jnp.square(linear))], axis=-1)
    product = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    ridge = _RIDGE * jnp.maximum(weight.sum(), 1.0) * jnp.eye(features.shape[-1])
    gram = product("nt,ntf,ntg->fg", weight, features, features) + ridge
    moment = product("nt,ntf,nt->f", weight, features, target)
    return product("ntf,f->nt", features, jax.scipy.linalg.solve(gram, moment, assume_a="pos"))


def standardize(features: jax.Array) -> jax.Array:
    """To mean 0 and std 1 over all but the last axis, and within bounds; what does not vary becomes 0."""
    mean, std = features.mean(axis=(0, 1)), features.std(axis=(0, 1))
    return jnp.clip((features - mean) / (std + 1e-4), -_LARGEST, _LARGEST)
