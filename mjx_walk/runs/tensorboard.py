"""TensorBoard's event files, without PyTorch.

tensorboardX imports PyTorch where it is installed, which takes seconds. Nothing here passes its tensors.
"""

import sys

_HAS_TORCH = "torch" in sys.modules
if not _HAS_TORCH:
    sys.modules["torch"] = None  # type: ignore[assignment]  # makes `import torch` fail
try:
    from tensorboardX import SummaryWriter
    from tensorboardX.proto.summary_pb2 import Summary
finally:
    if not _HAS_TORCH:
        del sys.modules["torch"]

__all__ = ["Summary", "SummaryWriter"]
