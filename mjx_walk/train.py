"""`python -m mjx_walk.train env=humanoid algo=ppo`: train one run, or a sweep with `-m`."""

import contextlib
import dataclasses
import itertools
import os
import sys
import textwrap
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict

from mjx_walk.algos import ALGORITHMS
from mjx_walk.api import resolve, resolve_seeds, train
from mjx_walk.cli import parsing
from mjx_walk.envs import TASKS
from mjx_walk.machine.signals import Stopped, exit_code
from mjx_walk.settings.config import (
    CONFIG_DIR,
    Config,
    compose_config,
    to_config,
    with_absolute_paths,
)
from mjx_walk.settings.input_files import check_inputs
from mjx_walk.settings.overrides import key_of_value, read_overrides
from mjx_walk.settings.own_hydra import own_hydra
from mjx_walk.settings.recipe_files import with_stored_recipes
from mjx_walk.settings.renamed import present_overrides
from mjx_walk.settings.value_sources import as_yaml_with_sources
from mjx_walk.storage.files import user_path
from mjx_walk.storage.run_folder import RunFolder, new_folder
from mjx_walk.training import launcher
from mjx_walk.training.distributed import Processes, join_processes
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import unknown
from mjx_walk.utils.setting_fields import describe, meanings, refuse_ineffective, table

__all__ = ["USAGE", "Own", "main"]

_NAMES = textwrap.fill(
    f"env={'|'.join(TASKS)}".replace("|", " | "), 100, initial_indent="  ", subsequent_indent="      "
)
USAGE = f"""
usage: python -m mjx_walk.train [env=humanoid] [algo=ppo] [KEY=VALUE ...]

{_NAMES}
  algo={" | ".join(ALGORITHMS)}
  physics=auto|warp|jax|c   num_envs=N   total_steps=N   seed=N   run_dir=PATH   resume=true
  seeds=N or [3,7]                        train several seeds in one program, each with its own folder
  devices=all or N                        train one run on N GPUs, with one process and num_envs environments each
  recipe=NAME or FILE.yaml                use another recipe of configs/recipe, or a file of your own
  env.task=FILE.py:CLASS                  train on a task of your own, see docs/your_own.md
  env.KEY=VALUE                           set one of Gymnasium's keywords, or env.version=v4
  algo.KEY=VALUE                          set an algorithm's setting
  -m seed=0,1,2                           run a Hydra sweep; Hydra's launchers work
  --cfg job                               print the configuration, with the source of each value, and exit
  algo=NAME --help                        also list the settings of the algorithm, with ranges and meanings
"""

_FLAGS_WITH_VALUE = ("--cfg", "-c", "--info", "-i", "--package", "-p", "--experimental-rerun")
_FLAGS = (*_FLAGS_WITH_VALUE, "--multirun", "-m", "--resolve", "--hydra-help", "--shell-completion", "-sc")
"""Flags of Hydra."""
_MULTIRUN, _CFG = {"--multirun", "-m"}, {"--cfg", "-c"}
_PRINTED = ("job", "hydra", "all")
"""Values of `--cfg`."""


@dataclasses.dataclass
class Own:
    """Arguments of the command that are not settings of a run."""

    seeds: Any = None
    """A number of seeds, or a list of them."""
    devices: Any = None
    """`all`, or a number of GPUs."""


def main(arguments: list[str]) -> int:
    """Train, and return the exit code."""
    if any(argument in ("-h", "--help") for argument in arguments):
        print(_help(arguments))
        return 0
    if any(argument.startswith("-") for argument in arguments):
        _through_hydra(arguments)
        return 0
    own, overrides = parsing.parse_own(Own, Config, arguments, USAGE, key_of_value)
    if own.seeds is not None and own.devices is not None:
        raise UserError("give seeds=… or devices=…, not both")
    processes = join_processes() if own.devices is not None else Processes()
    if processes.process_count > 1:
        return _train_in_process(overrides, processes)
    if own.devices is not None:
        count = launcher.count(own.devices)
        if count > 1:
            overrides = present_overrides(overrides)  # warns once instead of once per process
            resolve(overrides)  # so do errors
            return launcher.run([f"devices={own.devices}", *overrides], count)
    configs = resolve_seeds(overrides, parsing.read_seeds(own.seeds)) if own.seeds is not None else [resolve(overrides)]
    _, signal_name = train(configs)
    return exit_code(signal_name) if signal_name else 0


def _help(arguments: list[str]) -> str:
    """The usage, and the settings of the algorithm if one is given."""
    given = [argument.removeprefix("algo=") for argument in arguments if argument.startswith("algo=")]
    if not given:
        return USAGE.strip()
    if given[-1] not in ALGORITHMS:
        raise UserError(unknown("algo", given[-1], ALGORITHMS))
    schema = ALGORITHMS[given[-1]][1]
    meaning, indent = meanings(schema), " " * 6
    lines = []
    for row, line in zip(table(schema), describe(schema, "algo."), strict=True):
        text = meaning.get(row.name, "")
        lines += [f"  {line}", *textwrap.wrap(text, 112, initial_indent=indent, subsequent_indent=indent)]
    title = f"Settings of {given[-1]}, with their defaults. Recipes change some of them."
    note = "A setting that you give and that has no effect is refused."
    return "\n".join([USAGE.strip(), "", title, note, "", *lines])


def _train_in_process(overrides: list[str], processes: Processes) -> int:
    """Train as one process of several. Exit immediately on failure: JAX's shutdown would deadlock with the others."""
    try:
        _, signal_name = train([resolve(overrides)], processes=processes)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        os._exit(2)
    except KeyboardInterrupt as stop:  # during scoring, or the second Ctrl-C; messages are already printed
        sys.stdout.flush()
        os._exit(exit_code(stop.signal_name if isinstance(stop, Stopped) else "SIGINT"))
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    return exit_code(signal_name) if signal_name else 0


def _through_hydra(arguments: list[str]) -> None:
    """Print a configuration, or pass flags to Hydra: sweeps, launchers, `--info`.

    Raises:
        UserError: invalid arguments, or Hydra refuses them.
    """
    flags, others = _split(arguments)
    own, given = parsing.parse_own(Own, Config, others, USAGE, key_of_value)
    for flag in _CFG & flags.keys():
        if flags[flag] not in _PRINTED:
            raise UserError(f"{flag} prints a configuration; write --cfg job, --cfg hydra or --cfg all")
    if flags in ({"--cfg": "job"}, {"-c": "job"}):
        print(as_yaml_with_sources(given), end="")
        return
    for name, value in dataclasses.asdict(own).items():
        if value is not None:
            raise UserError(
                f"{name}=… does not go with {next(iter(flags))}; leave it out, or sweep seeds with -m seed=0,1,2"
            )
    is_sweep = bool(_MULTIRUN & flags.keys())
    overrides = read_overrides(given, is_sweep)
    swept = [override for override in overrides if override.is_sweep_override()]
    for override in swept:
        if not any(True for _ in override.sweep_iterator()):
            raise UserError(f"{override.input_line} gives no value; give one, or several with commas")
    # Reports errors in one line, where Hydra takes several.
    plain = [o for o in overrides if not o.is_sweep_override() and not o.key_or_group.startswith("hydra")]
    compose_config(plain, is_partial=bool(swept))
    if is_sweep and {*_CFG, "--info", "-i"} & flags.keys():
        raise UserError("-m trains a sweep and --cfg prints a configuration: give one of them")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    with _sweep_folder(is_sweep, [o.key_or_group for o in overrides]) as folder, own_hydra() as store:
        words = [f"{flag}={value}" if value else flag for flag, value in flags.items()]
        sys.argv = [sys.argv[0], *words, *with_stored_recipes(overrides, store), *folder]  # all overrides together
        try:
            hydra.main(config_path=CONFIG_DIR, config_name="train", version_base="1.3")(_sweep_job)()
        except HydraException as error:
            what, _, _ = str(error).partition("Config search path")
            raise UserError(" ".join(what.split())) from error


def _split(arguments: list[str]) -> tuple[dict[str, str], list[str]]:
    """Hydra's flags with their values, which are empty for a flag without one, and the other arguments."""
    flags: dict[str, str] = {}
    others = []
    for previous, argument in itertools.pairwise(["", *arguments]):
        flag, _, value = argument.partition("=")
        if flag in _FLAGS:
            flags[flag] = value
        elif previous in _FLAGS_WITH_VALUE and "=" not in argument and not argument.startswith("-"):
            flags[previous] = argument
        else:
            others.append(argument)
    return flags, others


@contextlib.contextmanager
def _sweep_folder(is_sweep: bool, keys: list[str]) -> Iterator[list[str]]:
    """Context manager that creates the folder of a sweep, and yields Hydra's override for it.

    Hydra alone would give two sweeps of the same second one folder. If the sweep fails early, the folder is removed.
    """
    if not is_sweep or "hydra.sweep.dir" in keys:
        yield []
        return
    folder = new_folder(Path("runs", "sweeps"))
    try:
        yield [f"hydra.sweep.dir={folder}"]
    finally:
        with contextlib.suppress(OSError):  # a folder is not empty
            for path in (folder, *folder.parents[:2]):
                path.rmdir()


def _sweep_job(node: DictConfig) -> None:
    """Train one job of a sweep in its own folder. Raise on errors, because exiting would end the other jobs as well.

    Raises:
        Stopped: a signal stopped the run. It ends the remaining jobs as well.
    """
    runtime = HydraConfig.get().runtime  # with hydra.job.chdir=true this job has another working directory
    with open_dict(node):
        node.run_dir = os.path.join(runtime.cwd, user_path(node.run_dir or runtime.output_dir))
    config = with_absolute_paths(to_config(node), Path(runtime.cwd))
    if config.resume:
        check_inputs(RunFolder(Path(node.run_dir)), config.env, config.env)
    else:
        refuse_ineffective(config, (o.partition("=")[0] for o in HydraConfig.get().overrides.task))
    _, signal_name = train([config])
    if signal_name:
        raise Stopped(signal_name)


if __name__ == "__main__":
    parsing.main(main)
