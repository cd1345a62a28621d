"""Command lines in Hydra's grammar: texts in quotes, and settings that follow from others."""

import os
import re
from collections.abc import Collection, Iterator

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, Quote, QuotedString, Sweep
from hydra.errors import HydraException

from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS
from mjx_walk.machine.devices import default_backend
from mjx_walk.settings.own_tasks import KEY, name_task
from mjx_walk.settings.presets import with_presets
from mjx_walk.settings.renamed import present_overrides
from mjx_walk.settings.schema import chosen, setting_types, text_keys
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import unknown
from mjx_walk.utils.value_types import plain_type, with_whole_number

__all__ = ["complete_overrides", "key_of_value", "named_values", "read_overrides", "sweep_choices"]

_HYDRA_FOLDERS = frozenset({"hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir"})
"""Hydra's own settings that hold a path. It does not sweep over them."""
_PARTS = re.compile(r"""(?:^|,)\s*('(?:[^'\\]|\\.)*'\s*(?=,|$)|"(?:[^"\\]|\\.)*"\s*(?=,|$)|[^,]*)""")
"""The parts of a sweep's text. A comma in a quoted part belongs to the part."""


def read_overrides(overrides: list[str], is_sweep: bool = False) -> list[Override]:
    """Translate former names, quote text, add what follows from others, and refuse forms that bypass the schema.

    Without `hardware=` the size of the recipe follows from the devices that JAX sees. `env.task=` runs the file that it
    names, and gives `env=`. `env.randomize=default` gives the settings of that preset.

    Args:
        overrides: arguments of the command line.
        is_sweep: whether a comma separates values; otherwise it may be a part of a path.

    Raises:
        UserError: `+key`, `++key` or `~key`, a malformed override, or an unknown environment or algorithm.
    """
    overrides = _with_named_task(with_presets(present_overrides(overrides)))
    read = []
    for text in _in_hydras_grammar(overrides, is_sweep):
        override = _read(text)
        if override is None:
            raise UserError(f"cannot read '{text}'; write {_correction(text)}")
        if not override.key_or_group.startswith("hydra"):
            _check(override)
        read.append(override)
    if not any(override.key_or_group == "hardware" for override in read):
        size = "cpu" if default_backend() == "cpu" else "gpu"  # JAX starts only after mistakes are reported
        read = [*OverridesParser.create().parse_overrides([f"hardware={size}"]), *read]
    return read


def complete_overrides(overrides: list[str], is_sweep: bool = False) -> list[str]:
    """The overrides that `read_overrides` gives for the same arguments, as text."""
    return [str(override.input_line) for override in read_overrides(overrides, is_sweep)]


def key_of_value(value: str) -> str | None:
    """The key of an environment's or an algorithm's name that is given alone."""
    return "env" if value in TASKS else "algo" if value in ALGORITHMS else None


def named_values(override: Override) -> list[str]:
    """The values of an override as text: several for `a,b`, and none for another kind of sweep."""
    if override.is_choice_sweep():
        return [value.strip("'\"") for value in override.sweep_string_iterator()]
    return [] if override.is_sweep_override() else [str(override.value())]


def sweep_choices(override: Override) -> list[str]:
    """An override for each value of a sweep, with text in quotes where Hydra would escape its characters."""
    choices = []
    for value in override.sweep_string_iterator():
        choice = f"{override.key_or_group}={value}"
        text = _value(choice)
        if isinstance(text, str) and "\\" in value and value[0] not in "'\"":
            choice = f"{override.key_or_group}={_in_quotes(text)}"
        choices.append(choice)
    return choices


def _with_named_task(overrides: list[str]) -> list[str]:
    """Overrides with `env=` for the task that `env.task=` names, whose file runs here."""
    sources = [override for override in overrides if override.partition("=")[0] == KEY]
    if not sources:
        return overrides
    text = sources[-1].partition("=")[2]
    name, source = name_task(str(_value(sources[-1]) or text) if text[:1] in ("'", '"') else text)
    rest = [override for override in overrides if override not in (*sources, f"env={name}")]
    for override in rest:
        if override.partition("=")[0] == "env":
            raise UserError(f"give {override} or {KEY}={source}, not both")
    return [f"env={name}", *rest, f"{KEY}={source}"]


def _in_hydras_grammar(overrides: list[str], is_sweep: bool) -> Iterator[str]:
    """Overrides that Hydra reads as they are meant: paths and names in quotes, and `total_steps=1e5` as `100000`."""
    env, algo = chosen(dict(override.split("=", 1) for override in overrides if "=" in override))
    types, texts = setting_types(env, algo), {"recipe", *text_keys(env, algo)}
    for override in overrides:
        key, equals, value = override.partition("=")
        if plain_type(types.get(key)) is int:
            value = ",".join(map(with_whole_number, value.split(",")))
        elif key in _HYDRA_FOLDERS:
            value = _quote(key, os.path.expanduser(value))
        elif key in texts:
            value = _quote_parts(key, value) if is_sweep else _quote(key, value)
        yield key + equals + value


def _check(override: Override) -> None:
    key, text = override.key_or_group, str(override.input_line)
    if override.is_add() or override.is_force_add() or override.is_delete():
        raise UserError(f"'{text}': keys cannot be added or removed; write {key}={text.partition('=')[2] or 'VALUE'}")
    if isinstance(override.value(), Glob):
        raise UserError(f"{text}: glob is not supported; list the values with commas, and add -m to train with each")
    if key in ("hardware", "recipe") and not override.is_sweep_override() and not isinstance(override.value(), str):
        raise UserError(f"{text}: give one name, or leave {key}= out")
    if key in ("env.xml_file", "env.reward_function") and override.value() == "":  # perhaps from an unset variable
        raise UserError(f"{key}= names no file; write its path, or {key}=null for Gymnasium's own")
    names: dict[str, Collection[str]] = {"env": TASKS, "algo": ALGORITHMS}
    for value in named_values(override) if key in names else ():
        if value not in names[key]:
            raise UserError(unknown(key, value, names[key]))


def _quote(key: str, text: str) -> str:
    """Text that Hydra reads as the given one. `null`, interpolations and text in quotes keep Hydra's meaning."""
    if not text or text.lower() == "null":
        return text
    value = _value(f"{key}={text}")
    return text if value == text or (isinstance(value, str) and text[0] in "'\"") else _in_quotes(text)


def _quote_parts(key: str, text: str) -> str:
    """Values of a sweep, each quoted where it needs to be. A sweep such as `choice(a,b)` stays."""
    value = _value(f"{key}={text}")
    if isinstance(value, Sweep) and not (isinstance(value, ChoiceSweep) and value.simple_form):
        return text
    return ",".join(_quote(key, part.strip()) for part in _PARTS.findall(text))


def _in_quotes(text: str) -> str:
    return QuotedString(text=text, quote=Quote.single).with_quotes()


def _value(override: str) -> object:
    """The value that Hydra reads; None for a malformed override."""
    read = _read(override)
    return read.value() if read else None


def _read(override: str) -> Override | None:
    """An override in Hydra's grammar; None for a malformed one."""
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException:
        return None


def _correction(override: str) -> str:
    """A correction of a malformed override: no spaces, one `=`, closed brackets. Without one, the general form."""
    key, equals, value = override.partition("=")
    value = re.sub(r"\s", "", value).strip("=,;")
    value = re.sub(r"^\((.*)\)$", r"[\1]", value)
    value += "]" * (value.count("[") - value.count("]"))
    corrected = f"{key.strip()}={value}"
    return corrected if equals and value and _read(corrected) else "KEY=VALUE"
