"""The first lines of a training."""

import logging

from mjx_walk.machine.devices import default_device
from mjx_walk.settings.config import Config
from mjx_walk.storage.run_folder import RunFolder

__all__ = ["announce"]

_LOGGER = logging.getLogger(__name__)


def announce(config: Config, folders: list[RunFolder], num_devices: int) -> None:
    """Log what is trained where, and what may surprise the user.

    Args:
        config: of the first run.
        folders: of all runs.
        num_devices: devices that train one run together.
    """
    device = default_device()
    where = device.device_kind if device.platform != "cpu" else "the CPU"
    where = where if num_devices == 1 else f"{num_devices} × {where}, one process each"
    path = folders[0].path if len(folders) == 1 else f"{len(folders)} folders of {folders[0].path.parent}"
    env, algo = config.env.name, config.algo
    _LOGGER.info("Training %s with %s on %s, physics=%s, in %s", env, algo.name, where, config.physics, path)
    if config.hardware == "cpu":
        _LOGGER.info(
            "JAX runs on the CPU: this is the recipe for a CPU. By default the physics is MuJoCo's C library. "
            "Expect a gait after minutes to tens of minutes; recipes for a GPU reach much higher scores."
        )
    if algo.learning_rate_schedule != "constant" and config.total_steps > algo.schedule_steps:
        _LOGGER.warning(
            "after algo.schedule_steps=%d the learning rate is zero; to learn until total_steps=%d, "
            "add algo.schedule_steps=%d",
            algo.schedule_steps,
            config.total_steps,
            config.total_steps,
        )
    if config.physics == "warp":
        _LOGGER.info("On the first run on a machine, Warp compiles its kernels, which takes half a minute or more.")
        if config.profile_calls > 1 and num_devices == 1:
            _LOGGER.warning("JAX's profiler has hung in a second recorded call of Warp on one GPU; use profile_calls=1")
