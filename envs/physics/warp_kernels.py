"""Kernels of MuJoCo Warp, compiled in parallel before a step needs them. The step would compile one after the other."""

import atexit
import contextlib
import logging
import math
import os
import shutil
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from unittest import mock

import mujoco
import warp as wp
from mujoco.mjx.third_party import mujoco_warp

from mjx_walk.storage.files import is_writable_folder, user_folder

__all__ = ["Variants", "choose_cache", "launched_variants", "load_kernels"]

_LOGGER = logging.getLogger("mjx_walk.progress")

_SECONDS_BETWEEN_MESSAGES = 5.0
_NUM_THREADS = 8
"""More threads would wait for each other, since Warp generates its code under a lock."""

Variants = dict[wp.Module, set[int | None]]
"""The block sizes by module with which its kernels are launched; None is the module's own."""


def choose_cache() -> None:
    """Have Warp keep its kernels until this process ends, where the user's cache folder is missing or read-only.

    Warp would create a folder named `~` in the working directory, or fail. A folder that the user has chosen stays.
    Call this function before Warp starts.
    """
    if wp.config.kernel_cache_dir or "WARP_CACHE_PATH" in os.environ:
        return
    folder = user_folder("XDG_CACHE_HOME", ".cache")
    if folder and is_writable_folder(folder / "warp"):
        return
    folder = Path(tempfile.mkdtemp(prefix="warp_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    wp.config.kernel_cache_dir = str(folder)
    warnings.warn(
        "Warp's kernels are not kept: there is no cache folder to write to; set WARP_CACHE_PATH", stacklevel=2
    )


def load_kernels(model: mujoco.MjModel, njmax: int, device: wp.Device) -> list[Future]:
    """Begin to load what `forward` and `step` launch. Threads compile what Warp's cache does not hold.

    Args:
        model: as the engine steps it.
        njmax: capacity for constraint rows, on which some kernels depend.
        device: to run on.

    Returns:
        A future for each module of kernels.
    """
    with wp.ScopedDevice(device):
        variants = launched_variants(model, njmax)
    progress = _Progress(len(variants))

    def load(module: wp.Module, block_sizes: set[int | None]) -> None:
        for size in block_sizes:  # one by one, since they share Warp's record of the module
            wp.force_load(device, [module], block_dim=size, max_workers=0)
        progress.count()

    # Large modules take longest. Those of tiles come next, because Warp keeps its lock while it compiles them.
    in_order = sorted(variants.items(), key=lambda item: (-len(item[0].kernels), None in item[1]))
    pool = ThreadPoolExecutor(_NUM_THREADS)
    futures = [pool.submit(load, module, sizes) for module, sizes in in_order]
    pool.shutdown(wait=False)
    return futures


class _Progress:
    """Says every few seconds how many modules are loaded. Loading from the cache takes less, and says nothing."""

    def __init__(self, num_modules: int):
        self._num_modules = num_modules
        self._num_loaded = 0
        self._said_at = time.monotonic()
        self._lock = threading.Lock()

    def count(self) -> None:
        """Count one more."""
        with self._lock:
            self._num_loaded += 1
            if time.monotonic() - self._said_at > _SECONDS_BETWEEN_MESSAGES:
                self._said_at = time.monotonic()
                _LOGGER.info("Warp has compiled %d of %d modules of kernels", self._num_loaded, self._num_modules)


def launched_variants(model: mujoco.MjModel, njmax: int) -> Variants:
    """Kernels that a step launches on Warp's present device. Nothing is launched, so nothing is compiled."""
    warp_model = mujoco_warp.put_model(model)
    warp_model.opt.warn_overflow = 0  # as the engine sets it; kernels depend on it
    data = mujoco_warp.make_data(model, nworld=1, njmax=njmax)
    variants: Variants = {}
    with _noting_launches(variants):
        mujoco_warp.forward(warp_model, data)
        mujoco_warp.step(warp_model, data)
    return variants


@contextlib.contextmanager
def _noting_launches(variants: Variants) -> Iterator[None]:
    """Replace Warp's launches by notes of the kernels, and follow each branch of its graphs once."""

    def launch(
        kernel: wp.Kernel, dim: int | Sequence[int], *_: object, block_dim: int | None = None, **__: object
    ) -> None:
        if math.prod(dim if isinstance(dim, Sequence) else [dim]):  # else Warp needs no kernel
            variants.setdefault(kernel.module, set()).add(block_dim)

    def capture_while(_: wp.array, while_body: Callable, stream: object = None, **arguments: object) -> None:
        while_body(**arguments)

    def capture_if(
        _: wp.array,
        on_true: Callable | None = None,
        on_false: Callable | None = None,
        stream: object = None,
        **arguments,
    ) -> None:
        for branch in filter(None, (on_true, on_false)):
            branch(**arguments)

    with mock.patch.multiple(
        wp, launch=launch, launch_tiled=launch, capture_while=capture_while, capture_if=capture_if
    ):
        yield
