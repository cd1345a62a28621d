"""Checkpoints of a run on several devices: the first one's where a run on one has them, the others' beside it."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mjx_walk.runs import checkpoint
from mjx_walk.training.distributed import Team
from mjx_walk.utils.types import TrainState

NUM_DEVICES = "num_devices"
"""Beside a checkpoint: how many there were."""
_KEYS = ("key", "noise_key")


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

    def part(path: Path) -> Path:
        before = checkpoint.read_meta(path).get(NUM_DEVICES, 1)
        return device_folder(checkpoints, rank % before) / path.name

    def agree(is_complete: bool) -> bool:
        return all(team.gather(is_complete)) if team else is_complete

    state, facts = checkpoint.restore_newest(checkpoints, like, part, agree)
    before = facts.get(NUM_DEVICES, 1)
    if rank >= before:
        keys = {name: jax.random.fold_in(getattr(state, name), rank) for name in _KEYS if hasattr(state, name)}
        state = state.replace(**keys)
    return (_recount(state, before, size) if before != size else state), facts


def _recount(state: TrainState, before: int, size: int) -> TrainState:
    """Counts of updates, of which a number of steps is fewer the more devices there are."""

    def scaled(updates: jax.Array) -> jax.Array:
        return jnp.int32(updates * before // size)

    live = state.env.live
    live = live.replace(snapshot_iteration=scaled(live.snapshot_iteration), best_iteration=scaled(live.best_iteration))
    return state.replace(iterations=scaled(state.iterations), env=state.env.replace(live=live))
