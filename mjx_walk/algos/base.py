"""The interface of a learning algorithm, and the state that all algorithms have."""

import abc
import copy
import dataclasses
from typing import ClassVar, Generic, Protocol, TypeVar

import flax
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, PRNGKeyArray

from mjx_walk.common.inline_evaluation import EvaluationConfig, InlineEvaluation, InlineEvaluator
from mjx_walk.envs import BaseTask
from mjx_walk.envs.physics import nothing_runs
from mjx_walk.envs.vector_env import VectorEnv, VectorState
from mjx_walk.utils.types import (
    ITERATION_COUNT,
    PER_DEVICE,
    RANDOM_KEY,
    Metrics,
    PolicyFn,
    PolicyParams,
    leaves_with,
)

__all__ = [
    "Algorithm",
    "AlgorithmConfig",
    "TrainState",
    "is_finite",
    "learned_leaves",
    "with_replay_of",
    "without_replay",
]


class TrainState(flax.struct.PyTreeNode):
    """Everything that influences the next iteration, and nothing else; each algorithm adds its own fields."""

    env: VectorState = flax.struct.field(metadata=PER_DEVICE)
    evaluation: InlineEvaluation = flax.struct.field(metadata=PER_DEVICE)
    key: Array = flax.struct.field(metadata=RANDOM_KEY)
    iterations: Array = flax.struct.field(metadata=ITERATION_COUNT)
    """`[] i32`: iterations so far."""


class AlgorithmConfig(Protocol):
    """Settings that every algorithm has."""

    init_at_random_episode_step: bool
    """Start the first episodes at random step counts."""


_StateT = TypeVar("_StateT", bound=TrainState)
_BatchT = TypeVar("_BatchT")
_ConfigT = TypeVar("_ConfigT", bound=AlgorithmConfig)


def learned_leaves(state: TrainState) -> dict[str, Array]:
    """Networks, optimizers and running statistics: the floating-point leaves that are not per device, by their paths.

    The other leaves need no check. A task ends an episode whose physics is not finite, and running returns enter the
    running statistics.
    """
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for (path, leaf), is_per_device in zip(leaves, leaves_with(state, "per_device"), strict=True)
        if not is_per_device and jnp.issubdtype(leaf.dtype, jnp.floating)
    }


def is_finite(state: TrainState) -> Bool[Array, ""]:
    """Whether every learned leaf is finite."""
    return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in learned_leaves(state).values()]))


def without_replay(state: _StateT) -> _StateT:
    """A TrainState, or its shapes, without the replay buffer."""
    return state.replace(**dict.fromkeys(_replay_fields(state), ()))


def with_replay_of(other: _StateT, state: _StateT) -> _StateT:
    """A TrainState with the replay buffer of another one."""
    return state.replace(**{name: getattr(other, name) for name in _replay_fields(state)})


def _replay_fields(state: TrainState) -> list[str]:
    return [field.name for field in dataclasses.fields(state) if field.metadata.get("replay")]


@dataclasses.dataclass(frozen=True, eq=False)
class Algorithm(abc.ABC, Generic[_StateT, _BatchT, _ConfigT]):
    """A learning algorithm for one task, as pure functions of its state.

    `Algorithm[State, Batch, Config]`: its `TrainState`, what `collect` passes to `learn`, and its settings.

    `collect` contains no gradients and `learn` no physics. An object is hashed by its identity and is static under
    `jit`; constants are built when it is constructed.
    """

    random_step_after_falls: ClassVar[bool] = False
    """Whether `init_at_random_episode_step` also holds for every second episode that follows a fall."""

    task: BaseTask
    """The unbatched environment."""
    num_envs: int
    """Environments that train, B."""
    evaluation: EvaluationConfig
    """Settings of the inline evaluation."""
    config: _ConfigT
    """Settings of the algorithm, copied."""
    axis_name: str | None = None
    """Mapped axis over devices in `learn`, if several devices train one run."""
    evaluator: InlineEvaluator = dataclasses.field(init=False, repr=False)
    env: VectorEnv = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        # Configurations are mutable, and the hash would not change with them.
        self._set(config=copy.deepcopy(self.config), evaluation=copy.deepcopy(self.evaluation))
        evaluator = InlineEvaluator(self.task, self.num_envs, self.evaluation, self.policy, self.steps_per_iteration)
        is_random = self.config.init_at_random_episode_step
        env = VectorEnv(self.task, self.num_envs, is_random, is_random and self.random_step_after_falls)
        self._set(evaluator=evaluator, env=env)

    def _set(self, **constants: object) -> None:
        """Set fields, during construction only."""
        for name, value in constants.items():
            object.__setattr__(self, name, value)

    @property
    @abc.abstractmethod
    def steps_per_iteration(self) -> int:
        """Environment steps of one `collect`, over all environments."""

    @property
    def replay_bytes(self) -> int:
        """Memory of the replay, if there is one."""
        return 0

    def start_iteration(self, state: _StateT, pool_key: PRNGKeyArray) -> tuple[VectorState, InlineEvaluation, Metrics]:
        """Renew the pool of random starts, and start the next evaluation round if one has ended.

        Returns:
            The environments, the evaluation, and the scores of `InlineEvaluator.next_round`.
        """
        env = self.env.renew_pool(state.env, pool_key)
        evaluation, scores = self.evaluator.next_round(
            state.evaluation, self.policy_params(state), state.iterations, env.pool
        )
        return env, evaluation, scores

    def state_shapes(self) -> _StateT:
        """Shapes and dtypes of the state, without running anything."""
        with nothing_runs():
            return jax.eval_shape(self.init, jax.random.PRNGKey(0))

    @abc.abstractmethod
    def init(self, key: PRNGKeyArray) -> _StateT:
        """The state before the first iteration."""

    @abc.abstractmethod
    def collect(self, state: _StateT) -> tuple[_StateT, _BatchT]:
        """Act and step all environments: `state → (state, batch)`."""

    @abc.abstractmethod
    def learn(self, state: _StateT, batch: _BatchT) -> tuple[_StateT, Metrics]:
        """Gradient steps on the batch: `(state, batch) → (state, metrics)`."""

    @abc.abstractmethod
    def policy_params(self, state: _StateT) -> PolicyParams:
        """The part of the state that the policy needs, small enough to ship."""

    @abc.abstractmethod
    def with_policy(self, state: _StateT, policy_params: PolicyParams) -> _StateT:
        """The state with another policy, which its evaluation does not know yet."""

    @abc.abstractmethod
    def policy(self, policy_params: PolicyParams, deterministic: bool = True) -> PolicyFn:
        """The policy as a function of observations and a key."""
