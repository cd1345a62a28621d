"""TensorBoard's event files, without PyTorch and without a thread.

tensorboardX imports PyTorch where it is installed, which takes seconds. Nothing here passes its tensors. Its writer has
a thread and a queue: once a write has failed, the thread is gone, and the full queue blocks the training for ever.
"""

import contextlib
import secrets
import socket
import struct
import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path

from mjx_walk.storage.files import Appender

_HAS_TORCH = "torch" in sys.modules
if not _HAS_TORCH:
    sys.modules["torch"] = None  # type: ignore[assignment]  # makes `import torch` fail
try:
    from tensorboardX.proto.event_pb2 import Event, SessionLog
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.record_writer import masked_crc32c
finally:
    if not _HAS_TORCH:
        del sys.modules["torch"]

__all__ = ["EventFile", "Summary"]


class EventFile:
    """A new event file in a run folder. If a write fails, it warns once and drops later events."""

    def __init__(self, run_dir: Path, resume_steps: int | None = None):
        """
        Args:
            run_dir: folder of the run.
            resume_steps: environment steps at which the run resumes. TensorBoard hides later ones of older files.
        """
        # TensorBoard reads files in the order of their names, whose first part is the time.
        unique = f"{int(time.time()):010d}.{socket.gethostname()}.{secrets.token_hex(4)}"
        self._path = run_dir / f"events.out.tfevents.{unique}"
        self._file: Appender | None = None
        try:
            self._file = Appender(self._path)
        except OSError as error:
            self._warn(error)
        first_step = 0 if resume_steps is None else resume_steps + 1
        self._write(Event(wall_time=time.time(), step=first_step, file_version="brain.Event:2"))
        if resume_steps is not None:
            start = SessionLog(status=SessionLog.START)
            self._write(Event(wall_time=time.time(), step=first_step, session_log=start))

    def add(self, values: Mapping[str, float | Summary.Image], env_steps: int) -> None:
        """Append numbers and images by their names, at a number of environment steps."""
        kinds = (("image" if isinstance(value, Summary.Image) else "simple_value") for value in values.values())
        summary = [
            Summary.Value(tag=name, **{kind: value}) for kind, (name, value) in zip(kinds, values.items(), strict=True)
        ]
        self._write(Event(wall_time=time.time(), step=env_steps, summary=Summary(value=summary)))

    def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, None
        if file:
            with contextlib.suppress(OSError):  # a network file system may report a failed write only here
                file.close()

    def _write(self, event: Event) -> None:
        """Append an event as a TFRecord: length, its checksum, content, its checksum."""
        if not self._file:
            return
        content = event.SerializeToString()
        length = struct.pack("<Q", len(content))
        checksums = (struct.pack("<I", masked_crc32c(part)) for part in (length, content))
        try:
            self._file.append(length + next(checksums) + content + next(checksums))
        except OSError as error:
            self._warn(error)

    def _warn(self, error: OSError) -> None:
        """Say that writing has failed, and stop it."""
        warnings.warn(f"{self._path} cannot be written ({error.strerror}); TensorBoard gets no more rows", stacklevel=4)
        self.close()
