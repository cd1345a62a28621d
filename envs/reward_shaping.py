"""Reward shaping and custom reward functions, for training only: scores in Gymnasium use Gymnasium's reward."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from mjx_walk.envs.physics import PhysicsState
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting

__all__ = ["RewardFunction", "RewardStep", "Shaping", "Terms", "check_shaping", "shaping_terms", "term_names"]

Terms = dict[str, Float[Array, ""]]
"""Signed reward terms by name, `[] f32` each."""


class RewardStep(NamedTuple):
    """One step of one environment: the input of a reward function."""

    terms: Terms
    """Gymnasium's reward terms."""
    reward: Array
    """`[] f32`: Gymnasium's reward."""
    before: PhysicsState
    """Physics state before the step."""
    after: PhysicsState
    """Physics state after the step: `qpos [nq]` in m and rad, `qvel [nv]` in m/s and rad/s."""
    obs: Array
    """`[observation_size] f32`, after the step."""
    action: Array
    """`[action_size] f32`, in Gymnasium's units."""
    terminated: Array
    """`[] bool`: whether the step terminated the episode."""
    dt: float
    """Duration of the step, s."""


RewardFunction = Callable[[RewardStep], Terms]
"""Maps a step to its reward terms. The reward is their sum."""


@dataclasses.dataclass
class Shaping:
    """Weights of additional reward terms; 0 disables a term. x points forward, y to the left."""

    keep_y: float = setting(0.0, at_least=0)
    """`exp(-y²)` with y in m, which rewards walking straight. Bodies that move in a plane have no y."""
    shaking: float = setting(0.0, at_least=0)
    """Minus the mean squared velocity of the joints that a motor moves, over all their axes: (rad/s)² or, for
    sliders, (m/s)². A free joint has axes of both kinds."""
    falling: float = setting(0.0, at_least=0)
    """-1 in the step that terminates the episode."""
    backward: float = setting(0.0, at_least=0)
    """Minus the root's backward speed, m/s."""


def check_shaping(shaping: Shaping, name: str, has_x: bool, has_y: bool, has_motors: bool, can_fall: bool) -> None:
    """Check that the shaping terms of a task have an effect.

    Args:
        shaping: weights.
        name: of the task.
        has_x: whether `qpos[0]` is the root's x.
        has_y: whether `qpos[1]` is the root's y.
        has_motors: whether a motor moves a joint.
        can_fall: whether a fall terminates the episode.

    Raises:
        UserError: the first term with a weight that has none.
    """
    for term, has_effect, reason in (
        ("backward", has_x, "has no x coordinate"),
        ("keep_y", has_y, "has no y coordinate"),
        ("shaking", has_motors, "has no motor that moves a joint"),
        ("falling", can_fall, "does not terminate on a fall"),
    ):
        weight = vars(shaping)[term]
        if weight and not has_effect:
            raise UserError(f"env.shaping.{term}={weight}: {name} {reason}; set it to 0")


def shaping_terms(shaping: Shaping, step: RewardStep, motor_dofs: Int[np.ndarray, " dofs"]) -> Terms:
    """Weighted shaping terms of a step, without the disabled ones.

    Args:
        shaping: weights.
        step: the step.
        motor_dofs: indices in `qvel` of the joints that a motor moves.
    """
    terms = {}
    if shaping.keep_y:
        terms["reward_keep_y"] = shaping.keep_y * jnp.exp(-jnp.square(step.after.qpos[1]))
    if shaping.shaking:
        terms["reward_shaking"] = shaping.shaking * -jnp.square(step.after.qvel[motor_dofs]).mean()
    if shaping.falling:
        terms["reward_falling"] = shaping.falling * -jnp.float32(step.terminated)
    if shaping.backward:
        speed = (step.after.qpos[0] - step.before.qpos[0]) / step.dt
        terms["reward_backward"] = shaping.backward * jnp.minimum(speed, 0.0)
    return terms


def term_names(function: RewardFunction, source: str, example: RewardStep, shaped: Terms) -> tuple[str, ...]:
    """Names of the terms that a reward function returns, found by tracing it.

    Args:
        function: the reward function.
        source: `PATH.py:FUNCTION`, for error messages.
        example: a step with the task's shapes.
        shaped: the shaping terms, whose names the function must not use.

    Raises:
        UserError: the function raises an exception, does not return a dict of scalars, or uses an invalid name.
    """
    problem = f"env.reward_function={source}: "
    try:
        terms = jax.eval_shape(lambda step: function(step._replace(dt=example.dt)), example)
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        raise UserError(f"{problem}{type(error).__name__}: {reason}") from error
    if not isinstance(terms, dict) or not terms or any(getattr(term, "shape", None) != () for term in terms.values()):
        raise UserError(f"{problem}must return a dict of scalars by name")
    for name in terms:
        if name in shaped:
            raise UserError(f"{problem}env.shaping already has the term '{name}'; choose another name")
        if not str(name).startswith("reward_"):
            raise UserError(f"{problem}the term's name '{name}' must begin with reward_")
    return tuple(terms)
