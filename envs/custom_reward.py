"""The reward of a task after a user's reward function and shaping."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from mjx_walk.envs.reward_shaping import RewardStep, Shaping, Terms, shaping_terms, term_names
from mjx_walk.envs.user_files import load_reward_function

__all__ = ["CustomReward"]


class CustomReward:
    """Replaces Gymnasium's terms by those of a reward function, if there is one, and adds shaping terms."""

    def __init__(self, source: str | None, shaping: Shaping, motor_dofs: Int[np.ndarray, " dofs"]):
        """
        Args:
            source: `PATH.py:FUNCTION` of the reward function, or None.
            shaping: weights of the shaping terms.
            motor_dofs: indices in `qvel` of the joints that a motor moves.

        Raises:
            UserError: a function that is missing or invalid.
        """
        self._source = source
        self._function = load_reward_function(source) if source else None
        self._shaping = shaping
        self._motor_dofs = motor_dofs

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of the reward function's files, by absolute path; empty without a reward function."""
        return self._function.hashes if self._function else {}

    @property
    def changes_reward(self) -> bool:
        """Whether the reward differs from Gymnasium's."""
        return self._function is not None or any(vars(self._shaping).values())

    def __call__(self, step: RewardStep) -> tuple[Terms, Float[Array, ""]]:
        """The terms of a step and their sum, from Gymnasium's."""
        terms, reward = step.terms, step.reward
        if self._function:
            terms = {name: jnp.float32(term) for name, term in self._function(step).items()}
            reward = sum(terms.values(), jnp.float32(0.0))
        added = shaping_terms(self._shaping, step, self._motor_dofs)
        return terms | added, sum(added.values(), reward)

    def term_names(self, example: RewardStep) -> tuple[str, ...]:
        """Names of all terms, found by tracing the reward function on a step with the task's shapes.

        Raises:
            UserError: the function fails on it, or returns something else than terms.
        """
        names, shaped = tuple(example.terms), shaping_terms(self._shaping, example, self._motor_dofs)
        if self._function:
            names = term_names(self._function, str(self._source), example, shaped)
        return (*names, *shaped)
