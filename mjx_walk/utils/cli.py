"""What all commands share: `key=value` arguments, and one line and exit code 2 for a user's mistake."""

import dataclasses
import difflib
import errno
import sys
import typing
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjx_walk.utils.compat import exempt_imports_from_gc, prepare_jax
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import validate
from mjx_walk.utils.signals import Stopped, exit_code

Arguments = TypeVar("Arguments")


def parse(schema: type[Arguments], arguments: list[str], usage: str) -> Arguments:
    """Read `key=value` arguments into a dataclass.

    Args:
        schema: dataclass with defaults; `validate` checks its ranges.
        arguments: as on the command line.
        usage: printed for `--help`.

    Raises:
        UserError: an unknown key, a wrong type, or a value out of range.
    """
    if any(argument in ("-h", "--help") for argument in arguments):
        print(usage.strip())
        raise SystemExit(0)
    known = [field.name for field in dataclasses.fields(schema)]  # type: ignore[arg-type]
    node, hints = OmegaConf.structured(schema), typing.get_type_hints(schema)
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or key not in known:
            problem = f"unknown key '{key}'" if equals else f"cannot read '{argument}', write key=value"
            raise UserError(f"{problem}; valid: {', '.join(known)}")
        try:
            is_text = hints[key] in (str, str | None)  # a folder may be called 007
            read = value if is_text else OmegaConf.from_dotlist([f"value={value}"]).value
            OmegaConf.update(node, key, read)
        except (OmegaConfBaseException, yaml.YAMLError) as error:
            raise UserError(f"{argument}: {str(error).splitlines()[0]}") from error
    parsed: Any = OmegaConf.to_object(node)
    validate(parsed)
    return parsed


def parse_own(
    schema: type[Arguments], others: type[Any], arguments: list[str], usage: str
) -> tuple[Arguments, list[str]]:
    """The same of those arguments whose keys are the schema's; and the rest, which are a training's settings.

    Args:
        schema: as for `parse`.
        others: dataclass of the training's settings.
        arguments: as on the command line.
        usage: printed for `--help`.

    Raises:
        UserError: a wrong type, a value out of range, or a key that looks like one of the schema's.
    """
    own_keys, other_keys = ([field.name for field in dataclasses.fields(kind)] for kind in (schema, others))  # type: ignore[arg-type]
    own: list[str] = []
    rest: list[str] = []
    for argument in arguments:
        key = argument.partition("=")[0]
        is_own = key in (*own_keys, "-h", "--help")
        (own if is_own else rest).append(argument)
        near = difflib.get_close_matches(key, own_keys + other_keys)
        is_known = is_own or key.lstrip("+~") in other_keys or "." in key or "/" in key
        if {*own_keys} & {*near} and not is_known:
            raise UserError(f"unknown key '{key}'; did you mean: {', '.join(near)}?")
    return parse(schema, own, usage), rest


def read_seeds(value: Any) -> list[int]:
    """`seeds=3` is 0, 1 and 2; `seeds=[3,7]` these.

    Raises:
        UserError: neither, or one twice.
    """
    seeds = list(range(value)) if type(value) is int else value
    are_seeds = isinstance(seeds, list) and all(type(seed) is int and 0 <= seed < 2**32 for seed in seeds)
    if are_seeds and seeds and len(set(seeds)) == len(seeds):
        return seeds
    raise UserError(f"seeds={value}: give a number of seeds, or a list of different seeds from 0 up")


def check_writable(path: Path) -> None:
    """Before work is done for a file.

    Raises:
        UserError: nothing can be written there.
    """
    is_new = not path.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
        if is_new:
            path.unlink()
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def check_suffix(path: Path | None, *suffixes: str) -> None:
    """Before work is done for a file.

    Raises:
        UserError: it is of a kind that is not written.
    """
    if path and path.suffix.lower() not in suffixes:
        raise UserError(f"{path}: give it one of these endings: {', '.join(suffixes)}")


def stay_on_cpu() -> None:
    """For a command that steps environments one by one with MuJoCo's C library, also where JAX would take a GPU.

    It has no effect on a process that has used JAX before.
    """
    jax.config.update("jax_platforms", "cpu")


_usual_format = warnings.formatwarning


def _in_one_line(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """A warning that is meant for the user without the line of code that it came from."""
    if category is UserWarning:
        return f"warning: {message}\n"
    return _usual_format(message, category, filename, lineno, line)


_DISK_TROUBLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)


def main(command: Callable[[list[str]], int | None]) -> NoReturn:
    """Run a command on the process's arguments and exit with its code; a mistake, a disk that is full or must not be
    written to, and Ctrl-C cost one line, and so does a warning."""
    warnings.formatwarning = _in_one_line
    exempt_imports_from_gc()
    prepare_jax()
    try:
        sys.exit(command(sys.argv[1:]) or 0)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        if error.errno not in _DISK_TROUBLE:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except Stopped as stopped:
        print(f"Stopped by {stopped.signal_name}.", file=sys.stderr)
        sys.exit(exit_code(stopped.signal_name))
    except KeyboardInterrupt:
        print("Stopped by Ctrl-C.", file=sys.stderr)
        sys.exit(exit_code("SIGINT"))
