"""Settings that declare their valid range, and where they have an effect, next to their default."""

import ast
import dataclasses
import inspect
import math
import operator
import textwrap
import typing
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.value_types import type_problem

__all__ = [
    "MAX_SEED",
    "AnyBut",
    "Dataclass",
    "Row",
    "describe",
    "has_effect",
    "in_yaml",
    "meanings",
    "refuse_ineffective",
    "setting",
    "table",
    "validate",
    "with_name",
]

Schema = TypeVar("Schema")
_Value = TypeVar("_Value")

MAX_SEED = 2**32 - 1
"""Largest seed. JAX's random keys hold 32 bits of it, so larger seeds would repeat smaller ones."""

_BOUNDS = {"above": operator.gt, "at_least": operator.ge, "at_most": operator.le, "below": operator.lt}
"""How a value compares with each of its bounds."""
_MAX_ITEMS = 100
"""Values that a list may have. Each layer of a network takes its time to compile."""
_MAX_INT = 10**12
"""No count is larger. JAX cannot hold shapes from 2**63 elements on, and some of its errors end the process."""


class Dataclass(Protocol):
    """An object of any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]


class AnyBut(NamedTuple):
    """A condition on a setting: every value except this one."""

    value: Any


def setting(
    default: _Value,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    choices: tuple[str, ...] | None = None,
    only_if: Mapping[str, object] | None = None,
    search: str | tuple[float, ...] | None = None,
) -> _Value:
    """A dataclass field with a default, a valid range and a condition.

    Args:
        default: its value unless another one is given.
        above: exclusive lower bound; for a tuple, of each item, as the other bounds.
        at_least: inclusive lower bound.
        at_most: inclusive upper bound.
        below: exclusive upper bound.
        choices: valid values.
        only_if: values of other settings of the same dataclass, or `AnyBut` a value. The setting has an effect if one
            of them matches and has an effect itself. An empty dictionary: the setting never has an effect.
        search: values that a study tries by default: a text in Hydra's grammar, such as `0.9,0.99`, or factors of the
            recipe's value.
    """
    limits = {"above": above, "at_least": at_least, "at_most": at_most, "below": below, "choices": choices}
    metadata = {k: v for k, v in (limits | {"only_if": only_if, "search": search}).items() if v is not None}
    return dataclasses.field(default=default, metadata=metadata)


def with_name(schema: type[Schema], name: str) -> type[Schema]:
    """A subclass of a dataclass whose field `name` has one valid value.

    Args:
        schema: dataclass whose fields have defaults.
        name: the value.
    """
    field = ("name", str, setting(name, choices=(name,)))
    return dataclasses.make_dataclass(schema.__name__, [field], bases=(schema,))


def validate(config: Dataclass | type[Dataclass], prefix: str = "") -> None:
    """Check the types and ranges of all settings of a dataclass, and then of the dataclasses in it.

    Settings of an inner dataclass may be computed from those around it, which are the ones to name.

    Raises:
        UserError: the first value of another type or out of range, with its full key. NaN is never in range.
    """
    hints = typing.get_type_hints(type(config))
    values = [(field, getattr(config, field.name)) for field in dataclasses.fields(config)]
    for field, value in sorted(values, key=lambda pair: dataclasses.is_dataclass(pair[1])):
        key = prefix + field.name
        if dataclasses.is_dataclass(value):
            validate(value, key + ".")
            continue
        mistake = type_problem(value, hints[field.name])
        if mistake:
            raise UserError(f"{key}={value!r}: {mistake}")
        items = value if isinstance(value, list | tuple) else (value,)
        if len(items) > _MAX_ITEMS:
            raise UserError(f"{key} has {len(items):,} values; give at most {_MAX_ITEMS}")
        for item in items:
            problem = _problem(item, field.metadata)
            if problem:
                raise UserError(f"{key}={value}: {problem}")


def _problem(value: Any, limits: Mapping[str, Any]) -> str | None:
    if value is None:
        return None
    if isinstance(value, float) and math.isnan(value):
        return "must be a number"
    for name, holds in _BOUNDS.items():
        if name in limits and not holds(value, limits[name]):  # also a value that compares with nothing
            return f"must be {name.replace('_', ' ')} {limits[name]}"
    if isinstance(value, int) and abs(value) > _MAX_INT:
        return f"must be at most {_MAX_INT}"
    if "choices" in limits and value not in limits["choices"]:
        return f"choose one of: {', '.join(limits['choices'])}"
    if ("above" in limits or "at_least" in limits) and isinstance(value, float) and math.isinf(value):
        return "must be finite"
    return None


def refuse_ineffective(config: object, keys: Iterable[str]) -> None:
    """Check that explicitly given settings have an effect under the values of the others.

    Args:
        config: dataclass with all values.
        keys: full keys of the given settings. Keys that are not in the dataclass are skipped.

    Raises:
        UserError: the first setting without effect, with the values that disable it.
    """
    for key in keys:
        owner, name = _find(config, key)
        blockers = _blockers(owner, name)
        if blockers is None:
            continue
        values = {key.removesuffix(name) + other: getattr(owner, other) for other in blockers}
        reason = " and ".join(f"{other}={in_yaml(value)}" for other, value in values.items())
        reason = f"with {reason}; change that, or" if reason else "here;"
        raise UserError(f"{key}={in_yaml(getattr(owner, name))} has no effect {reason} leave it out")


def has_effect(config: object, key: str) -> bool:
    """Whether a setting has an effect under the values of the others.

    Args:
        config: dataclass with all values.
        key: full key of the setting.
    """
    return _blockers(*_find(config, key)) is None


def _find(config: object, key: str) -> tuple[object, str]:
    """The dataclass that holds a setting, and the setting's name in it."""
    *sections, name = key.split(".")
    for section in sections:
        config = getattr(config, section, None)
    return config, name


def _blockers(owner: object, name: str) -> list[str] | None:
    """The settings whose values disable a setting, or None if it has an effect."""
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    conditions = next((field.metadata.get("only_if") for field in fields if field.name == name), None)
    if conditions is None:
        return None
    found: list[str] = []
    for other, wanted in conditions.items():
        value = getattr(owner, other)
        if not (value != wanted.value if isinstance(wanted, AnyBut) else value == wanted):
            found.append(other)
            continue
        further = _blockers(owner, other)
        if further is None:
            return None
        found += further
    return found


class Row(NamedTuple):
    """One setting as users read it."""

    name: str
    default: str
    """As in YAML."""
    valid: str
    """Valid range or choices; empty if every value of the type is valid."""
    condition: str
    """Values of other settings under which it has an effect; empty if it always has one."""


def table(schema: type) -> list[Row]:
    """A row for each setting of a dataclass.

    Settings that never have an effect, have a single valid value or hold further settings are left out.

    Args:
        schema: dataclass whose fields have defaults.
    """
    rows = []
    for field in dataclasses.fields(schema):
        conditions = field.metadata.get("only_if")
        is_group = field.default is dataclasses.MISSING
        if is_group or conditions == {} or len(field.metadata.get("choices", "ab")) == 1:
            continue
        condition = _as_text(conditions) if conditions else ""
        rows.append(Row(field.name, in_yaml(field.default), _range(field.metadata), condition))
    return rows


def describe(schema: type, prefix: str = "") -> list[str]:
    """A line for each row of `table`: `key=default`, its valid range, and where it has an effect.

    Args:
        schema: dataclass whose fields have defaults.
        prefix: start of the full keys, such as `algo.`.
    """
    lines = []
    for row in table(schema):
        notes = [row.valid, f"only with {row.condition}" if row.condition else ""]
        text = f"{prefix}{row.name}={row.default}"
        lines.append(f"{text:<48} {'; '.join(note for note in notes if note)}".rstrip())
    return lines


def meanings(schema: type) -> dict[str, str]:
    """The docstrings below the fields of a dataclass, by field. A field without one has that of the base class.

    Args:
        schema: dataclass whose source is available.
    """
    found: dict[str, str] = {}
    for kind in reversed(schema.__mro__[:-1]):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        assert isinstance(definition, ast.ClassDef)
        for field, below in zip(definition.body, definition.body[1:], strict=False):
            if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
                continue
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                found[field.target.id] = " ".join(str(below.value.value).split())
    return found


def _range(limits: Mapping[str, Any]) -> str:
    bounds = " and ".join(f"{name.replace('_', ' ')} {limits[name]}" for name in _BOUNDS if name in limits)
    return bounds or "|".join(limits.get("choices", ()))


def _as_text(conditions: dict[str, object]) -> str:
    alternatives = [
        f"{other} other than {in_yaml(wanted.value)}" if isinstance(wanted, AnyBut) else f"{other}={in_yaml(wanted)}"
        for other, wanted in conditions.items()
    ]
    return " or ".join(alternatives)


def in_yaml(value: object) -> str:
    """A value as a command line and a table of settings have it."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(in_yaml, value))}]"
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))
