"""The contract between tasks and trainers: the state of an environment, and what a trainer needs of a task."""

from typing import Protocol, runtime_checkable

import flax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from numpy.typing import ArrayLike

from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.randomization.episode import Draws
from mjx_walk.utils.errors import UserError

__all__ = [
    "MAX_ABS_VALUE",
    "NO_TIME_LIMIT",
    "Carry",
    "State",
    "TrainableTask",
    "check_action_shape",
    "first_state",
    "in_same_episode",
    "is_finite",
    "physics_state",
]

NO_TIME_LIMIT = 2**31 - 1
"""Value of `max_episode_steps` when a caller or a wrapper applies the time limit."""

MAX_ABS_VALUE = 1e10
"""Largest valid position or velocity, as in MuJoCo's own check (`mjMAXVAL`)."""

Carry = dict[str, Array]
"""Quantities of one step that the next step's reward needs, in addition to the physics state."""


class State(flax.struct.PyTreeNode):
    """State of one environment. It holds no MuJoCo data: the engine rebuilds them in each step."""

    physics: PhysicsState
    memory: Carry
    """The task's carry. Checkpoints store it under this name."""
    obs: Array
    """`[observation_size] f32`, in Gymnasium's order and units."""
    reward: Array
    """`[] f32`."""
    terminated: Array
    """`[] bool`: the task ended the episode, so no reward follows."""
    truncated: Array
    """`[] bool`: the episode reached the time limit."""
    steps: Array
    """`[] i32`: steps since the reset. In training, some episodes start at a random count: the first ones, and in
    off-policy algorithms every second one after a fall."""
    metrics: dict[str, Array]
    """`[] f32` each: the reward terms under the names of Gymnasium's `info`, `nonfinite` and `overflow`."""
    draws: Draws | None = None
    """Randomness of the episode; None if the task's physics are not randomized."""


def first_state(
    physics: PhysicsState,
    memory: Carry,
    obs: Float[Array, " observation_size"],
    metric_names: tuple[str, ...],
    draws: Draws | None = None,
) -> State:
    """The state at the start of an episode."""
    return State(
        physics=physics,
        memory=memory,
        obs=obs,
        reward=jnp.zeros((), jnp.float32),
        terminated=jnp.zeros((), bool),
        truncated=jnp.zeros((), bool),
        steps=jnp.zeros((), jnp.int32),
        metrics={name: jnp.zeros((), jnp.float32) for name in metric_names},
        draws=draws,
    )


def check_action_shape(action: ArrayLike | Array, expected: tuple[int, ...]) -> None:
    """Check an action before it is broadcast or converted.

    Raises:
        ValueError: it has another shape; Gymnasium's message.
    """
    if np.shape(action) != expected:
        raise ValueError(f"Action dimension mismatch. Expected {expected}, found {np.shape(action)}")


def physics_state(
    model: mujoco.MjModel,
    qpos: Float[Array | np.ndarray, " nq"],
    qvel: Float[Array | np.ndarray, " nv"],
    warmstart: Float[Array | np.ndarray, " nv"] | None = None,
    act: Float[Array | np.ndarray, " na"] | None = None,
    model_index: Int[Array, ""] | None = None,
) -> PhysicsState:
    """The physics state of a model at a position and velocity, in float32.

    Args:
        model: the model.
        qpos: m and rad.
        qvel: m/s and rad/s.
        warmstart: initial guess of the constraint solver, m/s² and rad/s². Default: zeros.
        act: activations of actuators. Default: zeros, as after `mj_resetData`.
        model_index: of a changed model, if the engine has some.

    Raises:
        UserError: an array has another shape.
    """
    sizes = {"qpos": model.nq, "qvel": model.nv, "warmstart": model.nv, "act": model.na}
    found = []
    for (name, size), array in zip(sizes.items(), (qpos, qvel, warmstart, act), strict=True):
        if array is not None and np.shape(array) != (size,):
            raise UserError(f"{name} has the shape {np.shape(array)}; give ({size},), and use jax.vmap for a batch")
        found.append(jnp.zeros(size, jnp.float32) if array is None else jnp.asarray(array, jnp.float32))
    position, velocity, guess, activation = found
    return PhysicsState(position, velocity, guess, activation if model.na else None, model_index)


def in_same_episode(old: State, new: State) -> State:
    """The new state with the steps of the old one and its randomness: its model, late actions and time of a push."""
    physics = new.physics._replace(model_index=old.physics.model_index)
    return new.replace(physics=physics, draws=old.draws, steps=old.steps)


def is_finite(arrays: tuple[Array, ...], limit: float = MAX_ABS_VALUE) -> Bool[Array, ""]:
    """Whether all elements are below `limit` in absolute value; NaN never is."""
    return jnp.array([jnp.all(jnp.abs(x) < limit) for x in arrays]).all()


@runtime_checkable
class TrainableTask(Protocol):
    """A task as trainers see it. All methods are pure functions of one unbatched environment."""

    observation_size: int
    action_size: int
    action_low: Array
    """`[action_size] f32`, in Gymnasium's units."""
    action_high: Array
    """`[action_size] f32`, in Gymnasium's units."""
    reward_terms: tuple[str, ...]
    """Names of the reward terms in `State.metrics`."""
    max_episode_steps: int
    """Time limit, after which `State.truncated` is set."""
    dt: float
    """Time of a step, s; infinite where steps have no duration."""

    def reset(self, key: PRNGKeyArray) -> State:
        """Random initial state."""
        ...

    def step(self, state: State, action: Float[Array, " action_size"]) -> State:
        """Next state. Its metrics hold the reward terms, `nonfinite` and `overflow`."""
        ...

    def measures(self, before: State, after: State) -> dict[str, Float[Array, ""]]:
        """Quantities of a step, by name with unit. Scores show their means over episodes; the default has none."""
        return {}

    def scale_action(self, action: Float[Array, "*batch action_size"]) -> Float[Array, "*batch action_size"]:
        """Actions in Gymnasium's units, from actions in [-1, 1]; values outside that range are clipped."""
        center = (self.action_high + self.action_low) / 2
        return center + (self.action_high - self.action_low) / 2 * jnp.clip(action, -1.0, 1.0)
