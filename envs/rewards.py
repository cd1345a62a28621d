"""Rewards beyond Gymnasium's: terms added by weight, or a function of your own. Scores in Gymnasium ignore them."""

import dataclasses
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_walk.envs.physics import PhysicsState
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting

Terms = dict[str, jax.Array]
"""Signed reward terms, `[] f32` each."""


class RewardStep(NamedTuple):
    """One step of one copy, as a reward sees it."""

    terms: Terms
    """Gymnasium's."""
    reward: jax.Array
    """`[] f32`: Gymnasium's."""
    before: PhysicsState
    after: PhysicsState
    """`qpos [nq]` in m and rad, `qvel [nv]` in m/s and rad/s."""
    obs: jax.Array
    """`[observation_size] f32`, after the step."""
    action: jax.Array
    """`[action_size] f32`, in Gymnasium's units."""
    terminated: jax.Array
    """`[] bool`."""
    dt: float
    """Seconds."""


RewardFunction = Callable[[RewardStep], Terms]
"""Gives all terms; their sum is the reward."""


@dataclasses.dataclass
class Shaping:
    """Weights of terms added to the reward; 0 leaves a term out. x is forward, y to the left."""

    keep_y: float = setting(0.0, at_least=0)
    """`exp(-y²)` at each step, y in m: for walking straight. Not in Walker2d, which has no y."""
    shaking: float = setting(0.0, at_least=0)
    """Minus the mean square of the last joint velocities, one for each motor, (rad/s)²."""
    falling: float = setting(0.0, at_least=0)
    """Minus one at the step that terminates the episode."""
    backward: float = setting(0.0, at_least=0)
    """Minus the root's speed where it moves backward, m/s."""


def shaping_terms(shaping: Shaping, step: RewardStep) -> Terms:
    """The terms whose weights are not 0."""
    speed = (step.after.qpos[0] - step.before.qpos[0]) / step.dt
    terms = {
        "keep_y": lambda: jnp.exp(-jnp.square(step.after.qpos[1])),
        "shaking": lambda: -jnp.square(step.after.qvel[-step.action.size :]).mean(),
        "falling": lambda: -jnp.float32(step.terminated),
        "backward": lambda: jnp.minimum(speed, 0.0),
    }
    weights = dataclasses.asdict(shaping)
    return {f"reward_{name}": weights[name] * term() for name, term in terms.items() if weights[name]}


def reward_file(source: str) -> Path:
    """The file in `PATH.py:FUNCTION`."""
    return Path(source.rpartition(":")[0]).expanduser()


def load_reward_function(source: str) -> RewardFunction:
    """Load a function from a Python file.

    Args:
        source: `PATH.py:FUNCTION`.

    Raises:
        UserError: there is no such file or function, or the file cannot be run.
    """
    path, name = reward_file(source), source.rpartition(":")[2]
    if not path.is_file():
        raise UserError(
            f"env.reward_function={source}: no file '{path if path.name else source}'; write PATH.py:FUNCTION"
        )
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise UserError(f"env.reward_function={source}: '{path}' is not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise UserError(f"env.reward_function={source}: {type(error).__name__}: {error}") from error
    if not callable(getattr(module, name, None)):
        raise UserError(f"env.reward_function={source}: '{path}' has no function '{name}'")
    return getattr(module, name)


def term_names(function: RewardFunction, source: str, example: RewardStep, shaped: Terms) -> tuple[str, ...]:
    """The names of a reward function's terms, which it must give for every step.

    Args:
        function: as loaded.
        source: where from.
        example: a step of the right shapes.
        shaped: the terms that are added to it.

    Raises:
        UserError: it fails, or does not give scalars by names of its own.
    """
    try:
        terms = jax.eval_shape(lambda step: function(step._replace(dt=example.dt)), example)
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        raise UserError(f"env.reward_function={source}: {type(error).__name__}: {reason}") from error
    if not isinstance(terms, dict) or not terms or any(getattr(term, "shape", None) != () for term in terms.values()):
        raise UserError(f"env.reward_function={source}: must return a dict of scalars by name")
    for name in terms:
        if not str(name).startswith("reward_") or name in shaped:
            problem = "is one of env.shaping's" if name in shaped else "does not begin with reward_"
            raise UserError(f"env.reward_function={source}: the term's name '{name}' {problem}; choose another")
    return tuple(terms)
