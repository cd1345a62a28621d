"""`python -m mjx_walk.train env=humanoid algo=ppo`: train one run, or a sweep with `-m`."""

import dataclasses
import os
import sys
import traceback
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict

from mjx_walk.api import resolve, resolve_seeds, train
from mjx_walk.runs.config import CONFIG_DIR, Config, complete_overrides, load_config, register_schemas, to_config
from mjx_walk.training import launcher
from mjx_walk.training.distributed import Processes, join_processes
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.signals import Stopped, exit_code

USAGE = """
usage: python -m mjx_walk.train [env=humanoid|humanoid_standup|walker2d] [algo=ppo] [KEY=VALUE ...]

  physics=auto|warp|jax|c   num_envs=N   total_steps=N   seed=N   run_dir=PATH   resume=true
  seeds=N or [3,7]                        several seeds side by side in one program, each in a folder of its own
  devices=all or N                        one run on the GPUs of this host, or of a cluster: a process and num_envs each
  recipe=PATH_BELOW_configs/recipe        another recipe than the one for the environment and the hardware
  env.KEY=VALUE                           Gymnasium's keywords, and version=v4 as env.version=v4
  algo.KEY=VALUE                          the algorithm's settings
  -m seed=0,1,2                           a sweep, by Hydra; its launchers work
  --cfg job                               print the configuration and stop
"""


@dataclasses.dataclass
class Own:
    """Arguments that are no settings of a run."""

    seeds: Any = None
    devices: Any = None


def main(arguments: list[str]) -> int:
    """Train. Returns the exit code."""
    if any(argument in ("-h", "--help") for argument in arguments):
        print(USAGE.strip())
        return 0
    if any(argument.startswith("-") for argument in arguments):
        _through_hydra(arguments)
        return 0
    own, settings = cli.parse_own(Own, Config, arguments, USAGE)
    if own.seeds is not None and own.devices is not None:
        raise UserError("give seeds=… or devices=…, not both")
    processes = join_processes() if own.devices is not None else Processes()
    if processes.process_count > 1:
        return _train_in_process(settings, processes)
    if own.devices is not None:
        count = launcher.count(own.devices)
        if count > 1:
            resolve(settings)  # reports invalid settings once
            return launcher.run(arguments, count)
    configs = resolve_seeds(settings, cli.read_seeds(own.seeds)) if own.seeds is not None else [resolve(settings)]
    _, signal_name = train(configs)
    return exit_code(signal_name) if signal_name else 0


def _train_in_process(settings: list[str], processes: Processes) -> int:
    """Train as one process of several. Exit immediately on failure: JAX's shutdown would deadlock with the others."""
    try:
        _, signal_name = train([resolve(settings)], processes=processes)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        os._exit(2)
    except KeyboardInterrupt as stop:  # while it is scored, or the second one; what is saved is said already
        sys.stdout.flush()
        os._exit(exit_code(stop.signal_name if isinstance(stop, Stopped) else "SIGINT"))
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    return exit_code(signal_name) if signal_name else 0


def _through_hydra(arguments: list[str]) -> None:
    """Hand flags to Hydra: sweeps, launchers, `--cfg`.

    Raises:
        UserError: Hydra does not accept them.
    """
    overrides = [a for a in arguments if not a.startswith("-") and ("=" in a or a[0] in "+~")]
    parsed = OverridesParser.create().parse_overrides(complete_overrides(overrides))
    plain = [o for o in parsed if not o.is_sweep_override() and not o.key_or_group.startswith("hydra")]
    load_config([str(o.input_line) for o in plain])  # says in one line what Hydra would say in many
    # Hydra's parser wants all overrides in one row.
    flags = [argument for argument in arguments if argument not in overrides]
    if {"-m", "--multirun"} & {*flags} and {"-c", "--cfg", "-i", "--info"} & {*flags}:
        raise UserError("-m trains a sweep and --cfg prints a configuration: give one of them")
    sys.argv = [sys.argv[0], *flags, str(parsed[0].input_line), *overrides]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    register_schemas()
    try:
        hydra.main(config_path=CONFIG_DIR, config_name="train", version_base="1.3")(_sweep_job)()
    except HydraException as error:
        what, _, _ = str(error).partition("Config search path")
        raise UserError(" ".join(what.split())) from error


def _sweep_job(node: DictConfig) -> None:
    """One job of a sweep, in its own folder. It raises on error: exiting would end the other jobs too."""
    if node.run_dir is None:
        with open_dict(node):
            node.run_dir = HydraConfig.get().runtime.output_dir
    _, signal_name = train([to_config(node)])
    if signal_name:
        raise Stopped(signal_name)  # also the jobs after it


if __name__ == "__main__":
    cli.main(main)
