"""Saves checkpoints in a thread, so that training continues."""

from collections.abc import Iterable
from concurrent import futures
from pathlib import Path
from typing import NamedTuple

from mjx_walk.storage import checkpoint
from mjx_walk.storage.arrays import HostArrays
from mjx_walk.storage.checkpoint_metadata import Metadata

__all__ = ["BackgroundSaver", "Part"]


class Part(NamedTuple):
    """Arguments of `checkpoint.save` for one folder."""

    path: Path
    tree: object
    """Pytree of arrays."""
    metadata: Metadata
    further: HostArrays = {}
    """Further arrays by name, on the host."""


class BackgroundSaver:
    """Writes checkpoints in the background, one at a time. Training waits only for the copy to the host."""

    def __init__(self, folder: Path, max_to_keep: int, config: str | None = None, prune_first: bool = False):
        """
        Args:
            folder: folder of the checkpoints.
            max_to_keep: number of newest checkpoints to keep.
            config: text of the configuration, of which each checkpoint holds a copy.
            prune_first: remove old checkpoints and replay buffers before a save rather than after it. Until then, the
                folder can go back by one checkpoint. `prune` removes the rest at the end.
        """
        self._folder = folder
        self._max_to_keep = max_to_keep
        self._config = config
        self._prune_first = prune_first
        self._executor = futures.ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._running: futures.Future[None] | None = None

    def save(self, *parts: Part) -> None:
        """Copy pytrees to the host and start to write them in order. Waits for the previous save first."""
        self.wait()
        copied = [part._replace(tree=checkpoint.to_host(part.tree) | part.further) for part in parts]
        self._running = self._executor.submit(self._save, copied)

    def wait(self) -> None:
        """Wait until the current save is complete.

        Raises:
            OSError: writing failed, for example because the disk is full.
        """
        running = self._running
        if running:
            futures.wait([running])  # if Ctrl-C ends it, the next call waits again
            self._running = None
            running.result()

    def prune(self) -> None:
        """Remove old checkpoints and replay buffers."""
        checkpoint.prune(self._folder, self._max_to_keep)

    def _save(self, parts: Iterable[Part]) -> None:
        steps = [int(part.path.name) for part in parts if part.path.name.isdigit()]
        if self._prune_first and steps:
            checkpoint.discard_from(self._folder, steps[0])
            self.prune()
        for part in parts:
            checkpoint.save(part.path, part.tree, part.metadata, config=self._config)
        if not self._prune_first:
            if steps:
                checkpoint.discard_from(self._folder, steps[0] + 1)
            self.prune()
