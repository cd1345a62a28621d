"""TensorBoard's event files, without PyTorch.

Where PyTorch is installed, tensorboardX imports it, for tensors that nothing here hands in; that takes seconds.
"""

import sys

_KNOWN = "torch" in sys.modules
if not _KNOWN:
    sys.modules["torch"] = None  # type: ignore[assignment]  # what Python takes for a module that is not there
try:
    from tensorboardX import SummaryWriter
    from tensorboardX.proto.summary_pb2 import Summary
finally:
    if not _KNOWN:
        del sys.modules["torch"]

__all__ = ["Summary", "SummaryWriter"]
