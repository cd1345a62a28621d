"""The state of off-policy algorithms, and the batch of one of their updates."""

from typing import Generic, NamedTuple, Protocol, Self, TypeVar, runtime_checkable

import flax
from brax.training.acme.running_statistics import RunningStatisticsState
from jax import Array

from mjx_walk.algos.base import TrainState
from mjx_walk.common import returns
from mjx_walk.common.replay_buffer import Replay
from mjx_walk.utils.types import RANDOM_KEY, REPLAY, RESTARTS, Params, Transition

__all__ = ["Batch", "Learner", "LearnerT", "OffPolicyState"]


class Batch(NamedTuple):
    """Transitions to learn from, and the settings that change over a run."""

    transitions: Transition
    """`[N, …]`, see `ReplayBuffer.sample`; observations normalized, actions in `[-1, 1]`."""
    reward_scale: Array
    rate_factor: Array | float
    """The factor of the learning rates."""
    remaining: Array | float
    """The fraction of `schedule_steps` that is left."""


@runtime_checkable
class Learner(Protocol):
    """Networks and optimizers of an algorithm, of which the policy acts."""

    @property
    def policy(self) -> Params:
        """Parameters of the policy."""
        ...

    def replace(self, **changes: object) -> Self:
        """A copy with other fields."""
        ...


LearnerT = TypeVar("LearnerT", bound=Learner)


class OffPolicyState(TrainState, Generic[LearnerT]):
    """State of an off-policy algorithm."""

    learner: LearnerT
    """Networks and optimizers."""
    critic_updates: Array = flax.struct.field(metadata=RESTARTS)
    """`[] i32`: critic updates so far."""
    normalizer: RunningStatisticsState
    return_scale: returns.ReturnScale
    replay: Replay = flax.struct.field(metadata=REPLAY)
    noise_key: Array = flax.struct.field(metadata=RANDOM_KEY)
    """The exploration noise of every step follows from it."""
