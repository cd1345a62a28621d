"""The best policy of a run, kept apart from the checkpoints: small enough to ship."""

from collections.abc import Callable
from typing import Any

import jax

from mjx_walk import checkpoint
from mjx_walk.errors import UserError
from mjx_walk.run_folder import RunFolder
from mjx_walk.types import Algorithm


def deterministic_act(algorithm: Algorithm, policy_params: Any) -> Callable[[Any], Any]:
    """The policy without noise, compiled: `obs […, observation_size] → action […, action_size]`, Gymnasium's units."""
    policy = algorithm.policy(policy_params, deterministic=True)
    return jax.jit(lambda obs: policy(obs, jax.random.PRNGKey(0)))


def load_best_policy(folder: RunFolder, like: Any) -> tuple[Any, dict[str, Any]]:
    """Read it back; see `checkpoint.restore`.

    Raises:
        UserError: the run has saved none yet, it is damaged, or it is of another environment.
    """
    if not folder.best_policy.exists():
        raise UserError(f"{folder.path} holds no policy yet; train it first")
    try:
        return checkpoint.restore(folder.best_policy, like)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(str(error)) from error
