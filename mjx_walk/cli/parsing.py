"""Frame of all commands: `key=value` arguments, output, and exit codes.

Invalid input prints a one-line error and exits with code 2.
"""

import dataclasses
import functools
import itertools
import re
import sys
import tempfile
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjx_walk.cli.console import console
from mjx_walk.cli.surroundings import check_surroundings, correctable
from mjx_walk.machine.compat import exempt_imports_from_gc, prepare_jax, standard_settings
from mjx_walk.machine.signals import Stopped, exit_code, ignore_at_exit
from mjx_walk.machine.subprocesses import end_with_parent
from mjx_walk.storage.files import check_replaceable
from mjx_walk.utils.errors import UserError, first_line
from mjx_walk.utils.near_misses import near_misses
from mjx_walk.utils.setting_fields import MAX_SEED, validate
from mjx_walk.utils.text import printable
from mjx_walk.utils.value_types import plain_type, type_mistake, with_whole_number
from mjx_walk.utils.versions import __version__

__all__ = [
    "check_suffix",
    "check_writable",
    "main",
    "parse",
    "parse_own",
    "read_seeds",
    "refuse_flags",
    "stay_on_cpu",
]

Arguments = TypeVar("Arguments")
_HELP = ("-h", "--help")
_MOST_LISTED = 12
"""Most keys that a message lists."""


def parse(schema: type[Arguments], arguments: list[str], usage: str) -> Arguments:
    """Read `key=value` arguments into a dataclass. `--help` prints the usage and exits.

    Args:
        schema: dataclass with defaults and ranges, see `settings.setting`.
        arguments: the command line.
        usage: text for `--help`.

    Raises:
        UserError: an unknown key, a wrong type, or a value out of range.
    """
    if any(argument in _HELP for argument in arguments):
        print(usage.strip())
        raise SystemExit(0)
    node, hints = OmegaConf.structured(schema), typing.get_type_hints(schema)
    known = list(hints)
    refuse_flags(arguments, functools.partial(_key_of_value, schema), hints)
    texts: dict[str, str] = {}
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key not in known:
            raise UserError(f"unknown key '{key}'; valid: {', '.join(known)}")
        if hints[key] in (str, str | None):  # a folder may be called 007 or ${x}
            texts[key] = value
            continue
        text = with_whole_number(value) if plain_type(hints[key]) is int else value
        try:
            OmegaConf.update(node, key, OmegaConf.from_dotlist([f"value={text}"]).value)
        except (OmegaConfBaseException, yaml.YAMLError) as error:
            mistake = type_mistake(key, value, hints[key])
            raise UserError(mistake or f"{argument}: {first_line(error)}") from error
    parsed: Any = dataclasses.replace(OmegaConf.to_object(node), **texts)  # type: ignore[type-var]
    validate(parsed)
    return parsed


def parse_own(
    schema: type[Arguments],
    others: type[object],
    arguments: list[str],
    usage: str,
    key_of: Callable[[str], str | None] = lambda value: None,
) -> tuple[Arguments, list[str]]:
    """Read the arguments whose keys are in the schema, and return the others, which are settings of a training run.

    Args:
        schema: as for `parse`.
        others: dataclass of a training run's settings.
        arguments: the command line.
        usage: text for `--help`.
        key_of: as for `refuse_flags`.

    Raises:
        UserError: a wrong type, a value out of range, or an unknown key that resembles one of the schema.
    """
    own_keys, other_keys = ([field.name for field in dataclasses.fields(kind)] for kind in (schema, others))  # type: ignore[arg-type]
    own: list[str] = []
    rest: list[str] = []
    hints = typing.get_type_hints(others) | typing.get_type_hints(schema)
    refuse_flags([argument for argument in arguments if argument not in _HELP], key_of, hints)
    for argument in arguments:
        key = argument.partition("=")[0]
        is_own = key in (*own_keys, *_HELP)
        (own if is_own else rest).append(argument)
        near = near_misses(key, own_keys + other_keys, cutoff=0.6)
        is_known = is_own or key.lstrip("+~") in other_keys or "." in key or "/" in key
        if {*own_keys} & {*near} and not is_known:
            raise UserError(f"unknown key '{key}'; did you mean: {', '.join(near)}?")
    return parse(schema, own, usage), rest


def refuse_flags(
    arguments: list[str],
    key_of: Callable[[str], str | None] = lambda value: None,
    hints: Mapping[str, object] | None = None,
) -> None:
    """Check that every argument is `key=value`, and say how to write one that is not: `--num_envs 5`, `env humanoid`.

    Args:
        arguments: a part of the command line.
        key_of: maps a value that is given alone to the key that is meant, if it can be guessed.
        hints: annotations of the keys. Another key is corrected only if it resembles one of them.

    Raises:
        UserError: an argument without `=` or without a key, or one that begins with a dash.
    """
    for argument, following in itertools.zip_longest(arguments, arguments[1:], fillvalue=""):
        key, equals, value = argument.partition("=")
        if (equals and key and not key.startswith("-")) or argument[:1] in ("+", "~"):  # Hydra's, refused elsewhere
            continue
        if not argument:
            raise UserError("an argument is empty; write KEY=VALUE")
        is_alone = equals or not following or ("=" in following[1:] or following.startswith("-"))
        given = argument if is_alone else f"{argument} {following}"
        if not argument.startswith("-") and key_of(argument):
            wanted, given = f"{key_of(argument)}={argument}", argument
        else:
            wanted = _as_override(key, value if is_alone else following.removeprefix("="), hints)
        is_key = re.fullmatch(r"[\w./]+=.*", wanted, re.DOTALL)
        raise UserError(f"cannot read '{given}'; write {wanted if is_key else 'KEY=VALUE'}")


def _as_override(key: str, value: str, hints: Mapping[str, object] | None) -> str:
    """`num_envs=5` for `--num-envs` and `5`, or the general form if no such key is known."""
    name, colon, after = key.lstrip("-").replace("-", "_").partition(":")
    if hints is not None and name not in hints and "." not in name:
        near = near_misses(name, hints, 1)
        if not near:
            return f"KEY=VALUE, where KEY is one of: {', '.join(hints)}" if len(hints) <= _MOST_LISTED else "KEY=VALUE"
        name = near[0]
    default = "true" if hints is not None and hints.get(name) is bool else "VALUE"
    return f"{name}={value or (after if colon else '') or default}"


def _key_of_value(schema: type, value: str) -> str | None:
    """The key whose choices a value is one of, or `run`, for a value that is given alone."""
    fields = {field.name: field.metadata.get("choices", ()) for field in dataclasses.fields(schema)}
    fitting = [name for name, choices in fields.items() if value in choices]
    is_run = "run" in fields and value not in fields and not value.startswith("-")
    return fitting[0] if fitting else "run" if is_run else None


def read_seeds(value: Any) -> list[int]:
    """Seeds as a list. `seeds=3` means 0, 1 and 2, and `seeds=[3,7]` means 3 and 7.

    Raises:
        UserError: neither a number nor a list of different seeds.
    """
    seeds = list(range(value)) if type(value) is int else value
    are_seeds = isinstance(seeds, list) and all(type(seed) is int and 0 <= seed <= MAX_SEED for seed in seeds)
    if are_seeds and seeds and len(set(seeds)) == len(seeds):
        return seeds
    raise UserError(
        f"seeds={value}: give a number of seeds, or a list of different seeds from 0 up: seeds=3 or seeds=[3,7]"
    )


def check_writable(path: Path) -> None:
    """Check that a file can be written, before a command works for it. The file stays as it is.

    Raises:
        UserError: the file or its folder cannot be written.
    """
    try:
        for folder in path.parents:
            if folder.exists() and not folder.is_dir():
                raise UserError(f"cannot write {path}: {folder} is a file; choose another path")
        path.parent.mkdir(parents=True, exist_ok=True)
        check_replaceable(path)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def check_suffix(path: Path | None, *suffixes: str) -> None:
    """Check that a file name ends in one of the suffixes, before a command works for it.

    Raises:
        UserError: another ending.
    """
    if path and path.suffix.lower() not in suffixes:
        raise UserError(f"{path}: give it one of these endings: {', '.join(suffixes)}")


def stay_on_cpu() -> None:
    """Run JAX on the CPU, for commands that step single environments with MuJoCo's C library.

    It has no effect once JAX has started.
    """
    jax.config.update("jax_platforms", "cpu")


def main(command: Callable[[list[str]], int | None]) -> NoReturn:
    """Run a command on the arguments of this process, and exit with its exit code.

    Invalid input, a full or read-only disk, a path that is too long, and Ctrl-C print one line instead of a traceback.
    """
    end_with_parent()
    with console(), standard_settings():
        exempt_imports_from_gc()
        prepare_jax()
        code = _exit_code_of(command)
        ignore_at_exit()
        sys.exit(code)


def _exit_code_of(command: Callable[[list[str]], int | None]) -> int:
    if "--version" in sys.argv[1:]:
        print(f"mjx_walk {__version__}")
        return 0
    try:
        try:
            check_surroundings(sys.argv[1:])
            return command(sys.argv[1:]) or 0
        finally:
            sys.stdout.flush()  # here, where a full disk is reported
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        reason = correctable(error)
        if not reason:
            raise
        print(f"error: {printable(reason)}", file=sys.stderr)
        return 2
    except Stopped as stopped:
        print(f"Stopped by {stopped.signal_name}.", file=sys.stderr)
        return exit_code(stopped.signal_name)
    except KeyboardInterrupt:
        print("Stopped by Ctrl-C.", file=sys.stderr)
        return exit_code("SIGINT")
