"""The places where trainings of a comparison or a study run: GPUs, or the CPU."""

from mjx_walk.machine.devices import count_devices
from mjx_walk.machine.nvidia import warn_of_unused_gpu
from mjx_walk.utils.errors import UserError

__all__ = ["find_slots"]


def find_slots(devices: int | None, per_device: int) -> tuple[str, list[int | None]]:
    """The hardware of this machine, `cpu` or `gpu`, and a place for each training that runs at a time.

    A place is the number of a GPU, or None on a CPU.

    Args:
        devices: GPUs to use; None: all.
        per_device: trainings that share a GPU.

    Raises:
        UserError: this machine has fewer GPUs.
    """
    hardware, available = count_devices()
    if hardware == "cpu":
        warn_of_unused_gpu()
    count = devices or available
    if count > available:
        raise UserError(f"devices={count}: this machine has {available}; leave it out to use all")
    slots: list[int | None] = list(range(count)) if hardware == "gpu" else [None]
    return hardware, slots * per_device
