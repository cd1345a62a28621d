"""Rows of a run in Weights & Biases, beside its own log."""

import importlib.util
import math
import secrets
from typing import Any

from mjx_walk.config import Config, flatten
from mjx_walk.errors import UserError
from mjx_walk.metrics import Row
from mjx_walk.run_folder import RunFolder


def require_wandb(config: Config) -> None:
    """Before a run begins that is to be logged there.

    Raises:
        UserError: the package is not installed, or nobody is logged in.
    """
    if not config.wandb_project:
        return
    if importlib.util.find_spec("wandb") is None:
        raise UserError(f"wandb_project={config.wandb_project} needs Weights & Biases: pip install wandb")
    import wandb

    if wandb.setup().settings.mode == "online":
        try:
            wandb.login()
        except wandb.errors.UsageError as error:
            advice = "log in with `wandb login`, or set WANDB_MODE=offline"
            raise UserError(f"wandb_project={config.wandb_project}: {advice}") from error


class WandbLog:
    """One W&B run for one run folder; a resumed run goes on in it. `WANDB_MODE=offline` keeps it on the disk."""

    def __init__(self, config: Config, folder: RunFolder):
        """
        Args:
            config: with `wandb_project`.
            folder: prepared run folder; `wandb_id.txt` in it says which run is its own.
        """
        import wandb

        identity = folder.path / "wandb_id.txt"
        if not identity.exists():
            identity.write_text(secrets.token_hex(4))
        self._run: Any = wandb.init(
            project=config.wandb_project,
            id=identity.read_text().strip(),
            name=f"{folder.path.parent.name}/{folder.path.name}",
            dir=str(folder.path),
            config=flatten(config),
            resume="allow",
        )

    def write(self, row: Row) -> None:
        """Log one row at its environment steps. Steps that are there already, from before a run was resumed, stay."""
        self._run.log({name: value for name, value in row.items() if math.isfinite(value)}, step=int(row["env_steps"]))

    def close(self) -> None:
        """Until everything is sent, or on the disk."""
        self._run.finish()
