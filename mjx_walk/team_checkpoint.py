"""Checkpoints of a run on several devices: the first one's where a run on one has them, the others' beside it."""

import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mjx_walk import checkpoint
from mjx_walk.errors import UserError
from mjx_walk.team import Team
from mjx_walk.types import TrainState

NUM_DEVICES = "num_devices"
"""Beside a checkpoint: how many there were."""


def device_folder(checkpoints: Path, rank: int) -> Path:
    """Where the checkpoints of a device lie."""
    return checkpoints / f"device_{rank}" if rank else checkpoints


def restore_newest(checkpoints: Path, like: TrainState, team: Team | None) -> tuple[TrainState, dict[str, Any]]:
    """The newest checkpoint of which all devices' parts are whole, on as many devices as there are now.

    Where there were fewer before, those that are new begin with a copy of what another one had, under keys of their
    own; where there were more, theirs is left.

    Raises:
        UserError: there is none, or it belongs to another run.
    """
    rank, size = (team.rank, team.size) if team else (0, 1)
    for path in reversed(checkpoint.list_steps(checkpoints)):
        found = None
        try:
            before = int(checkpoint.read_meta(path).get(NUM_DEVICES, 1))
            found = checkpoint.restore(device_folder(checkpoints, rank % before) / path.name, like)
        except ValueError as error:
            warnings.warn(f"{error}; falling back to the checkpoint before it", stacklevel=2)
        if (team and not all(team.gather(found is not None))) or found is None:
            continue
        state, facts = found
        if rank >= before:
            keys = {name: jax.random.fold_in(getattr(state, name), rank) for name in _KEYS if hasattr(state, name)}
            state = state.replace(**keys)
        return (_recount(state, before, size) if before != size else state), facts
    raise UserError(f"no usable checkpoint in {checkpoints}; nothing to resume")


_KEYS = ("key", "noise_key")


def _recount(state: TrainState, before: int, size: int) -> TrainState:
    """Counts of updates, of which a number of steps is fewer the more devices there are."""

    def scaled(updates: jax.Array) -> jax.Array:
        return jnp.int32(updates * before // size)

    live = state.env.live
    live = live.replace(snapshot_update=scaled(live.snapshot_update), best_update=scaled(live.best_update))
    return state.replace(updates=scaled(state.updates), env=state.env.replace(live=live))
