"""Command lines in Hydra's grammar: texts in quotes, and settings that follow from others."""

import dataclasses
import os
import re
import typing
from collections.abc import Collection

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, Quote, QuotedString, Sweep
from hydra.errors import HydraException

from mjx_walk.algos import ALGORITHMS
from mjx_walk.envs import TASKS, TaskOptions
from mjx_walk.machine.devices import default_backend
from mjx_walk.settings.own_tasks import KEY, name_task
from mjx_walk.settings.renamed import present_overrides
from mjx_walk.settings.schema import chosen, setting_types
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import unknown
from mjx_walk.utils.value_types import plain_type, with_whole_number

__all__ = ["complete_overrides", "key_of_value", "sweep_choices"]

_TEXTS = frozenset({"run_dir", "wandb_project", "recipe"})
"""Keys that hold any text, besides settings of tasks and algorithms."""
_HYDRA_FOLDERS = frozenset({"hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir"})
"""Hydra's own settings that hold a path. It does not sweep over them."""
_PARTS = re.compile(r"""(?:^|,)\s*('(?:[^'\\]|\\.)*'\s*(?=,|$)|"(?:[^"\\]|\\.)*"\s*(?=,|$)|[^,]*)""")
"""The parts of a sweep's text. A comma in a quoted part belongs to the part."""


def complete_overrides(overrides: list[str], is_sweep: bool = False) -> list[str]:
    """Translate former names, quote text, add what follows from others, and refuse forms that bypass the schema.

    Without `hardware=` the size of the recipe follows from the devices that JAX sees. `env.task=` runs the file that it
    names, and gives `env=`.

    Args:
        overrides: arguments of the command line.
        is_sweep: whether a comma separates values; otherwise it may be a part of a path.

    Raises:
        UserError: `+key`, `++key` or `~key`, a malformed override, or an unknown environment or algorithm.
    """
    overrides = _with_whole_numbers(_with_named_task(present_overrides(overrides)))
    parsed = [_parse(override) for override in _quote_texts(overrides, is_sweep)]
    for override in parsed:
        key = override.key_or_group
        if key.startswith("hydra"):
            continue
        if override.is_add() or override.is_force_add() or override.is_delete():
            text = str(override.input_line)
            value = text.partition("=")[2] or "VALUE"
            raise UserError(f"'{text}': keys cannot be added or removed; write {key}={value}")
        if key in ("hardware", "recipe") and not override.is_sweep_override() and not isinstance(override.value(), str):
            raise UserError(f"{override.input_line}: give one name, or leave {key}= out")
        known: Collection[str] | None = {"env": TASKS.keys(), "algo": ALGORITHMS.keys()}.get(key)
        for value in _values(override) if known else ():
            if known and value not in known:
                raise UserError(unknown(key, value, known))
    overrides = [str(override.input_line) for override in parsed]
    if not any(override.key_or_group == "hardware" for override in parsed):
        overrides = [f"hardware={'cpu' if default_backend() == 'cpu' else 'gpu'}", *overrides]
    return overrides


def key_of_value(value: str) -> str | None:
    """The key of an environment's or an algorithm's name that is given alone."""
    return "env" if value in TASKS else "algo" if value in ALGORITHMS else None


def sweep_choices(override: Override) -> list[str]:
    """An override for each value of a sweep, with text in quotes where Hydra would escape its characters."""
    choices = []
    for value in override.sweep_string_iterator():
        choice = f"{override.key_or_group}={value}"
        text = _parse(choice).value()
        if isinstance(text, str) and "\\" in value and value[0] not in "'\"":
            choice = f"{override.key_or_group}={QuotedString(text=text, quote=Quote.single).with_quotes()}"
        choices.append(choice)
    return choices


def _with_named_task(overrides: list[str]) -> list[str]:
    """Overrides with `env=` for the task that `env.task=` names, whose file runs here."""
    sources = [_text(override) for override in overrides if override.partition("=")[0] == KEY]
    if not sources:
        return overrides
    name, source = name_task(sources[-1])
    rest = [override for override in overrides if override.partition("=")[0] != KEY and override != f"env={name}"]
    for override in rest:
        if override.partition("=")[0] == "env":
            raise UserError(f"give {override} or {KEY}={source}, not both")
    return [f"env={name}", *rest, f"{KEY}={source}"]


def _values(override: Override) -> list[str]:
    """The values of an override as text: several for `a,b`, and none for another kind of sweep."""
    if override.is_choice_sweep():
        return [value.strip("'\"") for value in override.sweep_string_iterator()]
    return [] if override.is_sweep_override() else [str(override.value())]


def _with_whole_numbers(overrides: list[str]) -> list[str]:
    """Overrides in which integers are written as such: `total_steps=1e5` becomes `total_steps=100000`."""
    types = setting_types(*chosen(overrides))
    whole = []
    for override in overrides:
        key, equals, value = override.partition("=")
        if equals and plain_type(types.get(key)) is int:
            override = f"{key}={','.join(map(with_whole_number, value.split(',')))}"
        whole.append(override)
    return whole


def _quote_texts(overrides: list[str], is_sweep: bool) -> list[str]:
    """Overrides in which paths and names are quoted where Hydra would read something else.

    `null`, interpolations and text in quotes keep Hydra's meaning.

    Args:
        overrides: arguments of the command line.
        is_sweep: whether a comma separates values.
    """
    texts = _text_keys(overrides)
    quoted = []
    for override in overrides:
        key, equals, value = override.partition("=")
        if equals and key in _HYDRA_FOLDERS:
            override = f"{key}={_quote(key, os.path.expanduser(value))}"
        elif equals and key in texts:
            override = f"{key}={_quote_parts(key, value) if is_sweep else _quote(key, value)}"
        quoted.append(override)
    return quoted


def _quote(key: str, text: str) -> str:
    """Text that Hydra reads as the given one."""
    if not text or text.lower() == "null":
        return text
    if _is_readable(f"{key}={text}"):
        value = _parse(f"{key}={text}").value()
        if value == text or (isinstance(value, str) and text[0] in "'\""):
            return text
    return QuotedString(text=text, quote=Quote.single).with_quotes()


def _quote_parts(key: str, text: str) -> str:
    """Values of a sweep, each quoted where it needs to be. A sweep such as `choice(a,b)` stays."""
    value = _parse(f"{key}={text}").value() if _is_readable(f"{key}={text}") else None
    if isinstance(value, Sweep) and not (isinstance(value, ChoiceSweep) and value.simple_form):
        return text
    return ",".join(_quote(key, part.strip()) for part in _PARTS.findall(text))


def _text(override: str) -> str:
    """The value of an override that holds text, without Hydra's quotes."""
    value = override.partition("=")[2]
    return str(_parse(override).value()) if value[:1] in ("'", '"') and _is_readable(override) else value


def _is_readable(override: str) -> bool:
    """Whether an override is in Hydra's grammar."""
    try:
        return bool(OverridesParser.create().parse_override(override))
    except HydraException:
        return False


def _parse(override: str) -> Override:
    """Parse an override.

    Raises:
        UserError: it is malformed.
    """
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException as error:
        raise UserError(f"cannot read '{override}'; write {_readable(override)}") from error


def _readable(override: str) -> str:
    """A correction of a malformed override: no spaces, one `=`, closed brackets. Without one, the general form."""
    key, equals, value = override.partition("=")
    value = re.sub(r"\s", "", value).strip("=,;")
    value = re.sub(r"^\((.*)\)$", r"[\1]", value)
    value += "]" * (value.count("[") - value.count("]"))
    corrected = f"{key.strip()}={value}"
    return corrected if equals and value and _is_readable(corrected) else "KEY=VALUE"


def _text_keys(overrides: list[str]) -> set[str]:
    """Keys of the settings that hold any text: paths and names."""
    given = {"env": "humanoid", "algo": "ppo"} | dict(o.split("=", 1) for o in overrides if "=" in o)
    options = TASKS.get(given["env"], (None, TaskOptions))[1]
    keys = set(_TEXTS)
    for prefix, schema in (("env.", options), ("algo.", ALGORITHMS.get(given["algo"], ALGORITHMS["ppo"])[1])):
        hints = typing.get_type_hints(schema)
        fields = (field for field in dataclasses.fields(schema) if "choices" not in field.metadata)
        keys |= {prefix + field.name for field in fields if hints[field.name] in (str, str | None)}
    return keys
