"""`python -m mjx_walk.bench env=humanoid`: speeds of training and its parts on this machine, next to Gymnasium's."""

import dataclasses
import json
from collections.abc import Iterable
from typing import Any

import jax

from mjx_walk.api import resolve
from mjx_walk.cli import parsing
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.experiments import profile, scaling, timing
from mjx_walk.experiments.timing import Measurement
from mjx_walk.machine.devices import default_device
from mjx_walk.settings.config import Config
from mjx_walk.settings.overrides import key_of_value
from mjx_walk.storage.files import user_path, write_text
from mjx_walk.training import launcher
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.versions import package_versions

__all__ = ["USAGE", "Arguments", "device_counts", "main"]

USAGE = """
usage: python -m mjx_walk.bench [env=humanoid] [algo=ppo] [KEY=VALUE ...] [seconds=5] [devices=all] [peers=false]
                                [out=bench.json]

  KEY=VALUE  as for train: physics=jax num_envs=2048 algo.num_epochs=4; by default the recipe for this hardware
  seconds    time to measure each speed
  devices    measure instead how training scales over GPUs of this host: on 1, 2, 4 … up to this number, or on the
             listed numbers (devices=[1,4]); first with num_envs environments on each, then with num_envs in all
  peers      also measure Brax's PPO (algo=ppo) or SAC (algo=sac) on Brax's own, reduced humanoid; this takes some
             minutes, mostly to compile
  out        write the table as JSON, with package versions
"""


@dataclasses.dataclass
class Arguments:
    """Arguments that are not settings of the training."""

    seconds: float = setting(5.0, above=0)
    devices: Any = None
    peers: bool = False
    out: str | None = None


def main(command_line: list[str]) -> None:
    """Measure, print a table, and write JSON if asked."""
    arguments, overrides = parsing.parse_own(Arguments, Config, command_line, USAGE, key_of_value)
    config = resolve(overrides)
    algo = config.algo.name
    if arguments.peers and algo not in ("ppo", "sac"):
        raise UserError(f"Brax has no {algo} to compare with; omit peers, or choose algo=ppo or algo=sac")
    jax.config.update("jax_default_matmul_precision", config.matmul_precision)
    if arguments.out:
        parsing.check_writable(user_path(arguments.out))
    sizes = device_counts(arguments.devices)
    print("Short training runs in child processes …", flush=True)
    # They run first, before this process allocates the device's memory.
    if sizes:
        results = _print(scaling.measure(overrides, config, sizes, arguments.seconds))
    else:
        results = _print(timing.measure_first_calls(overrides))
    task = make_task(config)
    device = f"{default_device().device_kind}, physics={task.engine.name}, {config.num_envs} environments"
    print(f"{task.gymnasium_id} on {device}", flush=True)
    if not sizes:
        results |= _print(profile.measure(config, task, arguments.seconds))
    if arguments.peers:
        from mjx_walk.experiments import peers  # Brax's trainers take seconds to import

        results |= _print(peers.measure(algo, config.hardware))
    if arguments.out:
        content = {"env": task.gymnasium_id, "device": device, "results": results, "versions": package_versions()}
        write_text(user_path(arguments.out), json.dumps(content, indent=1))


def _print(measurements: Iterable[Measurement]) -> dict[str, float]:
    """Print each measurement as it comes, and return the values by name."""
    results = {}
    for name, value, unit in measurements:
        results[name] = value
        print(f"  {name:<48} {value:>12,.1f} {unit}", flush=True)
    return results


def device_counts(asked: Any) -> list[int]:
    """Numbers of GPUs to measure: 1, 2, 4 … and the number asked for, or the listed ones; none if none is asked for.

    Raises:
        UserError: this host has fewer GPUs.
    """
    if asked is None:
        return []
    if isinstance(asked, list) and asked:
        return sorted({launcher.count(size) for size in asked})
    most = launcher.count(asked)
    return sorted({most} | {2**power for power in range(most.bit_length())})


if __name__ == "__main__":
    parsing.main(main)
