"""Whether a value has the type of its setting, in the words of a command line."""

import dataclasses
import os
import re
import types
import typing
from decimal import Decimal
from typing import Any

import numpy as np

__all__ = ["plain_type", "type_mistake", "type_problem", "with_whole_number"]

_PLAIN = {
    bool: ("must be true or false", (bool, np.bool_)),
    int: ("must be an integer", (typing.SupportsIndex,)),
    float: ("must be a number", (typing.SupportsFloat,)),
    str: ("must be a string", (str, os.PathLike)),
}
"""For each type of a setting, what is said of other values, and the types of valid ones."""
_PLURALS: dict[object, str] = {int: "integers", float: "numbers", str: "names", bool: "values true or false"}
_NUMBER = r"[+-]?\d[\d_]*(\.\d*)?([eE][+-]?\d+)?"
_MOST_DIGITS = 30
"""Larger numbers stay as they are: none is valid."""
_UNITS = {"k": 1_000, "m": 1_000_000, "b": 1_000_000_000}


def plain_type(hint: object) -> object:
    """The type of a setting without `| None`."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        return kinds[0] if len(kinds) == 1 else Any
    return hint


def type_problem(value: object, hint: object) -> str | None:
    """Describe the wrong type of a value, or return None. Types that no setting of this package has are not checked.

    Args:
        value: the value.
        hint: annotation of the setting.
    """
    kind = plain_type(hint)
    if value is None and kind is not hint:
        return None
    if kind in _PLAIN:
        says, valid = _PLAIN[kind]
        is_bool = isinstance(value, bool | np.bool_)
        return None if isinstance(value, valid) and is_bool == (kind is bool) else says
    if dataclasses.is_dataclass(kind):
        return None if isinstance(value, kind) else _must_be(kind)  # type: ignore[arg-type]
    if typing.get_origin(kind) is tuple:
        items, length = _items(kind)
        if not isinstance(value, list | tuple | np.ndarray) or length not in (None, len(value)):
            return _must_be(kind)
        return _must_be(kind) if any(type_problem(item, items) for item in value) else None
    return None


def type_mistake(key: str, text: str, hint: object) -> str | None:
    """The error for a text that is not of its setting's type, and what to type instead. None for unknown types.

    Args:
        key: full key of the setting.
        text: its value on a command line.
        hint: annotation of the setting.
    """
    kind = plain_type(hint)
    problem = _must_be(kind)
    if problem is None:
        return None
    if dataclasses.is_dataclass(kind):
        keys = ", ".join(f"{key}.{field.name}" for field in dataclasses.fields(kind))
        return f"{key}={text}: {key} is a group of settings; give one of them: {keys}"
    correction = _correction(key, text, kind)
    return f"{key}={text}: {problem.partition(', such')[0] if correction else problem}{correction}"


def with_whole_number(text: str) -> str:
    """The text of an integer, where it is written as a whole number such as `1e5` or `8.0`; else the same text."""
    if not re.fullmatch(_NUMBER, text):
        return text
    number = Decimal(text)
    if number.adjusted() > _MOST_DIGITS or number != number.to_integral_value():
        return text
    return str(int(number)) if re.search(r"[.eE]", text) else text


def _correction(key: str, text: str, kind: object) -> str:
    """Suggest what to type instead of a text, if it can be guessed."""
    if kind is int:
        in_units = re.fullmatch(rf"({_NUMBER})([kKmMbB])", text)
        if re.fullmatch(r"\d{1,3}(,\d{3})+", text):
            return f"; write {key}={text.replace(',', '')}"
        if in_units:
            return f"; write {key}={int(Decimal(in_units[1]) * _UNITS[in_units[4].lower()])}"
    if typing.get_origin(kind) is tuple:
        items, length = _items(kind)
        parts = text.strip("()[] ,").split(",")
        patterns: dict[object, str] = {int: r"\s*[+-]?\d+\s*", float: rf"\s*{_NUMBER}\s*"}
        pattern = patterns.get(items, ".+")
        if all(re.fullmatch(pattern, part) for part in parts) and length in (None, len(parts)):
            return f"; write {key}=[{','.join(part.strip() for part in parts)}]"
    return ""


def _must_be(kind: object) -> str | None:
    if kind in _PLAIN:
        return _PLAIN[kind][0]
    if dataclasses.is_dataclass(kind):
        return f"must be a {getattr(kind, '__name__', kind)} or a dictionary of its settings"
    if typing.get_origin(kind) is tuple:
        items, length = _items(kind)
        count = "" if length is None else f"{length} "
        example = f", such as [{','.join(map(str, range(1, length + 1)))}]" if length and items in (int, float) else ""
        return f"must be a list of {count}{_PLURALS.get(items, 'values')}{example}"
    return None


def _items(kind: object) -> tuple[object, int | None]:
    """The type of a tuple's items, and their number unless any number is valid."""
    kinds = typing.get_args(kind)
    return (kinds[0], None) if kinds[-1] is Ellipsis else (kinds[0] if len(set(kinds)) == 1 else Any, len(kinds))
