"""`python -m mjx_walk.bench env=humanoid`: the first call's time and the speed of training on this machine."""

import dataclasses
import json
from collections.abc import Iterable, Iterator
from typing import Any

from mjx_walk.api import resolve
from mjx_walk.cli import parsing
from mjx_walk.envs import BaseTask
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.experiments import scaling, timing
from mjx_walk.experiments.timing import Measurement
from mjx_walk.machine.devices import default_device
from mjx_walk.settings.config import Config
from mjx_walk.settings.overrides import key_of_value
from mjx_walk.storage.files import user_path, write_text
from mjx_walk.training import launcher
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.versions import package_versions

__all__ = ["USAGE", "Arguments", "describe_device", "device_counts", "main", "show", "write"]

USAGE = """
usage: python -m mjx_walk.bench [env=humanoid] [algo=ppo] [KEY=VALUE ...] [seconds=5] [devices=all] [out=bench.json]

  KEY=VALUE  as for train: physics=jax num_envs=2048 algo.num_epochs=4; by default the recipe for this hardware
  seconds    least time to measure each speed
  devices    measure instead how training scales over GPUs of this host: on 1, 2, 4 … up to this number, or on the
             listed numbers (devices=[1,4]); first with num_envs environments on each, then with num_envs in all
  out        write the table as JSON, with package versions

In a clone of the repository, python benchmarks/training_parts.py measures the parts of training, and
python benchmarks/peers.py measures Brax's trainers.
"""


@dataclasses.dataclass
class Arguments:
    """Arguments that are not settings of the training."""

    seconds: float = setting(5.0, above=0)
    devices: Any = None
    out: str | None = None


def main(command_line: list[str]) -> None:
    """Measure, print a table, and write JSON if asked."""
    if any(argument.partition("=")[0] == "peers" for argument in command_line):
        raise UserError(
            "bench does not measure peers; in a clone of the repository, run python benchmarks/peers.py algo=ppo"
        )
    arguments, overrides = parsing.parse_own(Arguments, Config, command_line, USAGE, key_of_value)
    config = resolve(overrides)
    if arguments.out:
        parsing.check_writable(user_path(arguments.out))
    sizes = device_counts(arguments.devices)
    print("Short training runs in child processes …", flush=True)
    # They run first, before this process allocates the device's memory.
    if sizes:
        results = show(scaling.measure(overrides, config, sizes, arguments.seconds))
    else:
        results = show(_measure(overrides, arguments.seconds))
    task = make_task(config)
    device = describe_device(task, config)
    print(f"{task.gymnasium_id} on {device}", flush=True)
    if arguments.out:
        write(arguments.out, task.gymnasium_id, device, results)


def _measure(overrides: list[str], seconds: float) -> Iterator[Measurement]:
    yield from timing.measure_first_calls(overrides)
    yield Measurement("training", scaling.measure_speed(overrides, 1, seconds).steps_per_second, "env-steps/s")


def describe_device(task: BaseTask, config: Config) -> str:
    """The device, the engine and the number of environments."""
    return f"{default_device().device_kind}, physics={task.engine.name}, {config.num_envs} environments"


def show(measurements: Iterable[Measurement]) -> dict[str, float]:
    """Print each measurement as it comes, and return the values by name."""
    results = {}
    for name, value, unit in measurements:
        results[name] = value
        print(f"  {name:<48} {value:>12,.1f} {unit}", flush=True)
    return results


def write(path: str, env: str, device: str, results: dict[str, float]) -> None:
    """Write values by name as JSON, with what was measured on what, and the versions of packages."""
    content = {"env": env, "device": device, "results": results, "versions": package_versions()}
    write_text(user_path(path), json.dumps(content, indent=1))


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
