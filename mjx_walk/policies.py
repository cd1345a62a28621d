"""The best policy of a run, kept apart from the checkpoints: small enough to ship."""

from typing import Any

from mjx_walk import checkpoint
from mjx_walk.errors import UserError
from mjx_walk.run_folder import RunFolder


def save_best_policy(folder: RunFolder, policy_params: Any, facts: dict[str, Any]) -> None:
    """Replace the run's best policy."""
    checkpoint.save(folder.best_policy, policy_params, facts)


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
