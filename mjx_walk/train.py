"""`python -m mjx_walk.train env=humanoid algo=ppo`: train one run, or a sweep with `-m`."""

import contextlib
import dataclasses
import os
import sys
import textwrap
import traceback
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
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
    load_config,
    to_config,
    with_absolute_paths,
)
from mjx_walk.settings.input_files import check_inputs
from mjx_walk.settings.overrides import complete_overrides, key_of_value
from mjx_walk.settings.own_hydra import own_hydra
from mjx_walk.settings.recipe_files import with_stored_recipes
from mjx_walk.settings.renamed import present_overrides
from mjx_walk.settings.value_sources import as_yaml_with_sources
from mjx_walk.storage.files import user_path
from mjx_walk.storage.run_folder import RunFolder, new_folder
from mjx_walk.training import launcher
from mjx_walk.training.distributed import Processes, join_processes
from mjx_walk.utils.errors import UserError
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

_HYDRAS_FLAGS_WITH_VALUE = ("--cfg", "-c", "--info", "-i", "--package", "-p", "--experimental-rerun")
_PRINTED = ("job", "hydra", "all")
"""Values of `--cfg`."""
_HYDRAS_OTHER_FLAGS = ("--multirun", "-m", "--resolve", "--hydra-help", "--shell-completion", "-sc")


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
    overrides = present_overrides(overrides)
    if own.seeds is not None and own.devices is not None:
        raise UserError("give seeds=… or devices=…, not both")
    processes = join_processes() if own.devices is not None else Processes()
    if processes.process_count > 1:
        return _train_in_process(overrides, processes)
    if own.devices is not None:
        count = launcher.count(own.devices)
        if count > 1:
            resolve(overrides)  # reports invalid settings once instead of once per process
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
        raise UserError(f"unknown algo '{given[-1]}'; choose one of: {', '.join(ALGORITHMS)}")
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


def _without_hydras(arguments: list[str]) -> list[str]:
    """The arguments that are not Hydra's flags or their values."""
    flags = (*_HYDRAS_FLAGS_WITH_VALUE, *_HYDRAS_OTHER_FLAGS)
    before = ["", *arguments]
    return [
        argument
        for argument, previous in zip(arguments, before, strict=False)
        if argument.partition("=")[0] not in flags and previous not in _HYDRAS_FLAGS_WITH_VALUE
    ]


def _check_cfg(arguments: list[str]) -> None:
    """Check the value of `--cfg`, about which Hydra prints several lines.

    Raises:
        UserError: it is missing or unknown.
    """
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=True):
        flag, equals, value = argument.partition("=")
        if flag in ("--cfg", "-c") and (value if equals else following) not in _PRINTED:
            raise UserError(f"{flag} prints a configuration; write --cfg job, --cfg hydra or --cfg all")


def _through_hydra(arguments: list[str]) -> None:
    """Pass flags to Hydra: sweeps, launchers, `--cfg`.

    Raises:
        UserError: Hydra refuses the arguments.
    """
    hints = typing.get_type_hints(Config) | typing.get_type_hints(Own)
    parsing.refuse_flags(_without_hydras(arguments), key_of_value, hints)
    _check_cfg(arguments)
    given = [a for a in arguments if not a.startswith("-") and ("=" in a or a.startswith(("+", "~")))]
    flags = [argument for argument in arguments if argument not in given]
    if flags in (["--cfg", "job"], ["-c", "job"], ["--cfg=job"], ["-c=job"]):
        given = present_overrides(given)
        load_config(given)  # reports errors in one line
        print(as_yaml_with_sources(given), end="")
        return
    overrides = complete_overrides(given, is_sweep=bool({"-m", "--multirun"} & {*flags}))
    parsed = OverridesParser.create().parse_overrides(overrides)
    for override in parsed:
        if override.is_sweep_override() and not any(True for _ in override.sweep_iterator()):
            raise UserError(f"{override.input_line} gives no value; give one, or several with commas")
    plain = [o for o in parsed if not o.is_sweep_override() and not o.key_or_group.startswith("hydra")]
    # Reports errors in one line, where Hydra takes several. A swept setting may enable others.
    check = compose_config if any(o.is_sweep_override() for o in parsed) else load_config
    check([str(o.input_line) for o in plain])
    if {"-m", "--multirun"} & {*flags} and {"-c", "--cfg", "-i", "--info"} & {*flags}:
        raise UserError("-m trains a sweep and --cfg prints a configuration: give one of them")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    with _sweep_folder(flags, [override.key_or_group for override in parsed]) as folder, own_hydra() as store:
        # Hydra wants all overrides together.
        sys.argv = [sys.argv[0], *flags, *with_stored_recipes(overrides, store), *folder]
        try:
            hydra.main(config_path=CONFIG_DIR, config_name="train", version_base="1.3")(_sweep_job)()
        except HydraException as error:
            what, _, _ = str(error).partition("Config search path")
            raise UserError(" ".join(what.split())) from error


@contextlib.contextmanager
def _sweep_folder(flags: list[str], keys: list[str]) -> Iterator[list[str]]:
    """Context manager that creates the folder of a sweep, and yields Hydra's override for it.

    Hydra alone would give two sweeps of the same second one folder. If the sweep fails early, the folder is removed.
    """
    if not {"-m", "--multirun"} & {*flags} or "hydra.sweep.dir" in keys:
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
