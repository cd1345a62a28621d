"""Which values are of a setting's type."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_walk.utils.value_types import type_mistake, type_problem, with_whole_number


@dataclasses.dataclass
class Group:
    size: int = 1


@pytest.mark.parametrize(
    ("value", "hint"),
    [
        *((3, int), (np.int64(3), int), (jnp.int32(3), int), (None, int | None), (5, int | None)),
        *((3, float), (3.5, float), (np.float32(3.5), float), (jnp.float32(3.5), float)),
        *((True, bool), (np.bool_(True), bool), ("text", str), (None, str | None)),
        *(([1, 2], tuple[int, ...]), ((), tuple[int, ...]), ((0.5, 1), tuple[float, float])),
        *((np.zeros(2), tuple[float, float]), (Group(), Group), (object(), object), ({}, dict[str, int])),
    ],
)
def test_valid(value, hint):
    assert type_problem(value, hint) is None


@pytest.mark.parametrize(
    ("value", "hint", "problem"),
    [
        (True, int, "must be an integer"),
        (3.0, int, "must be an integer"),
        (None, int, "must be an integer"),
        ("3", float, "must be a number"),
        (True, float, "must be a number"),
        (1, bool, "must be true or false"),
        (1, str | None, "must be a string"),
        (3, tuple[int, ...], "must be a list of integers"),
        ([0.5], tuple[int, ...], "must be a list of integers"),
        ((1.0, 2.0, 3.0), tuple[float, float], "must be a list of 2 numbers, such as [1,2]"),
        (1, tuple[str, ...], "must be a list of names"),
        (1, Group, "must be a Group or a dictionary of its settings"),
    ],
)
def test_invalid(value, hint, problem):
    assert type_problem(value, hint) == problem


@pytest.mark.parametrize(
    ("text", "number"),
    [
        *(("1e5", "100000"), ("1E+5", "100000"), ("2.50e1", "25"), ("8.", "8"), ("-3.0", "-3"), ("1_0e1", "100")),
        *(
            ("5", "5"),
            ("1_000", "1_000"),
            ("1.5", "1.5"),
            ("1e-3", "1e-3"),
            ("1e99", "1e99"),
            ("1e9999999", "1e9999999"),
        ),
        *(("many", "many"), ("", ""), ("0x10", "0x10"), ("nan", "nan")),
    ],
)
def test_whole_numbers(text, number):
    assert with_whole_number(text) == number


@pytest.mark.parametrize(
    ("text", "hint", "mistake"),
    [
        ("2k", int, "key=2k: must be an integer; write key=2000"),
        ("1.5M", int | None, "key=1.5M: must be an integer; write key=1500000"),
        ("1,000,000", int, "key=1,000,000: must be an integer; write key=1000000"),
        ("1,5", int, "key=1,5: must be an integer"),
        ("a,b", tuple[str, ...], "key=a,b: must be a list of names; write key=[a,b]"),
        ("3", tuple[float, float], "key=3: must be a list of 2 numbers, such as [1,2]"),
        ("3", Group, "key=3: key is a group of settings; give one of them: key.size"),
        ("3", object, None),
    ],
)
def test_corrections(text, hint, mistake):
    assert type_mistake("key", text, hint) == mistake
