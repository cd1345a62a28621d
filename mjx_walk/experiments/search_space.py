"""The settings that a study searches, with the values that it may try, and the recipe that it starts from."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep

from mjx_walk.settings.config import Config, flatten, load_config
from mjx_walk.settings.overrides import complete_overrides, sweep_choices
from mjx_walk.settings.schema import setting_types
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import has_effect
from mjx_walk.utils.value_types import plain_type, with_whole_number

__all__ = ["Choices", "Interval", "SearchSpace", "Value", "default_space", "read_space"]

_SCORING = "evaluation.gymnasium_episodes"
_RESERVED = {
    "seed": "write seeds=[{}]",
    "run_dir": "write out={}",
    "resume": "leave it out, since the same command continues a study",
    "stop_at_return": "leave it out, since trials are compared after the same number of steps",
}
"""Settings of a run that a study chooses itself, and what to write instead."""
_ONE_OF_THEM = ("env", "algo", "recipe", "hardware", "env.task")
_LOG = "log"
Value = float | int | str


@dataclasses.dataclass(frozen=True)
class Interval:
    """Numbers from `low` to `high`, both included."""

    low: float
    high: float
    is_log: bool
    """Whether equal ratios are equally likely."""
    is_int: bool

    def __str__(self) -> str:
        text = f"interval({self.low:.12g},{self.high:.12g})"
        return f"tag({_LOG},{text})" if self.is_log else text

    def find(self, value: object) -> Value | None:
        """The value itself if it lies in the interval, else None."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return value if self.low <= value <= self.high else None


@dataclasses.dataclass(frozen=True)
class Choices:
    """A list of values."""

    labels: tuple[Value, ...]
    """Numbers; other values as a command line has them."""
    values: tuple[object, ...] = dataclasses.field(repr=False)
    """The same values as `config.yaml` has them."""

    def __str__(self) -> str:
        return ",".join(map(str, self.labels))

    def find(self, value: object) -> Value | None:
        """The label of a value, or None if it is not among the choices."""
        return next((label for label, own in zip(self.labels, self.values, strict=True) if own == value), None)


@dataclasses.dataclass(frozen=True)
class SearchSpace:
    """What a study varies and what it keeps."""

    fixed: tuple[str, ...]
    """Overrides that all trials have."""
    recipe: Config
    """The configuration that these overrides give, without any of the values that the study tries."""
    ranges: dict[str, Interval | Choices]
    """The values to try, by the full keys of their settings."""

    def overrides(self, values: Mapping[str, Value]) -> list[str]:
        """The overrides of a trial.

        Args:
            values: its values by the keys of `ranges`; a key without one keeps the recipe's.
        """
        return [*self.fixed, *(f"{key}={value}" for key, value in values.items())]

    @property
    def recipe_values(self) -> dict[str, Value]:
        """The recipe's own values, as far as the ranges contain them."""
        settings = flatten(self.recipe)
        found = {key: values.find(settings[key]) for key, values in self.ranges.items()}
        return {key: value for key, value in found.items() if value is not None}


def read_space(overrides: list[str], hardware: str, with_defaults: bool = False) -> SearchSpace:
    """Read what to search from a command line, and check that every value is valid.

    A setting with several values, or with Hydra's `interval`, `range` or `choice`, is searched. The others are fixed.
    Without a searched setting, the algorithm's default ranges apply, except those of fixed settings.

    Args:
        overrides: as for `train`.
        hardware: `gpu` or `cpu`, the size of the recipe.
        with_defaults: whether the default ranges also apply where some settings are searched.

    Raises:
        UserError: an invalid setting, a value out of its setting's range, or a setting that cannot be searched.
    """
    fixed, searched = _split(complete_overrides([f"hardware={hardware}", *overrides], is_sweep=True))
    if not any(text.startswith(f"{_SCORING}=") for text in fixed):
        fixed.append(f"{_SCORING}=0")
    recipe = load_config(fixed)
    if with_defaults or not searched:
        given = {override.key_or_group for override in searched} | {text.partition("=")[0] for text in fixed}
        defaults = (f"{key}={text}" for key, text in default_space(recipe).items() if key not in given)
        searched += OverridesParser.create().parse_overrides(complete_overrides(list(defaults), is_sweep=True)[1:])
    if not searched:
        raise UserError(
            f"nothing to search: {recipe.algo.name} has no default ranges that are left; "
            "give some, such as algo.discount=0.97,0.99"
        )
    texts = {override.key_or_group: _texts(override) for override in searched}
    most = max(map(len, texts.values()))
    # Each configuration checks a value of every setting.
    rows = ([f"{key}={own[min(i, len(own) - 1)]}" for key, own in texts.items()] for i in range(most))
    settings = [flatten(load_config([*fixed, *row])) for row in rows]
    types = setting_types(recipe.env.name, recipe.algo.name)
    ranges: dict[str, Interval | Choices] = {}
    for override in searched:
        key = override.key_or_group
        values = [row[key] for row in settings[: len(texts[key])]]
        ranges[key] = _range(override, values, texts[key], plain_type(types[key]) is int)
    return SearchSpace(tuple(fixed), recipe, ranges)


def default_space(recipe: Config) -> dict[str, str]:
    """The ranges that the settings of an algorithm declare, as a command line has them, by their full keys.

    Args:
        recipe: gives the values that factors multiply. Settings without an effect under it are left out.
    """
    found = {}
    for field in dataclasses.fields(recipe.algo):
        search, key = field.metadata.get("search"), f"algo.{field.name}"
        if search is None or not has_effect(recipe, key):
            continue
        found[key] = search if isinstance(search, str) else _multiples(getattr(recipe.algo, field.name), search)
    return found


def _multiples(value: float, factors: Iterable[float]) -> str:
    """Multiples of a value that are whole numbers from 1 up where the value is one."""
    scaled = (max(round(value * factor), 1) if isinstance(value, int) else value * factor for factor in factors)
    return ",".join(map(str, dict.fromkeys(scaled)))


def _split(completed: list[str]) -> tuple[list[str], list[Override]]:
    """The fixed overrides, and those that give several values."""
    fixed, searched = [], []
    keys: set[str] = set()
    for override in OverridesParser.create().parse_overrides(completed):
        key, text = override.key_or_group, str(override.input_line)
        if key in keys:
            raise UserError(f"'{text}': {key} is given twice")
        keys.add(key)
        if key in _RESERVED:
            raise UserError(f"'{text}': in a study {_RESERVED[key].format(text.partition('=')[2])}")
        if not override.is_sweep_override():
            fixed.append(text)
        elif key in _ONE_OF_THEM:
            raise UserError(f"'{text}': a study has one {key.rpartition('.')[2]}; give one value")
        elif not (key.startswith("algo.") or key == "num_envs"):
            raise UserError(f"'{text}': a study searches num_envs and settings of the algorithm; give {key} one value")
        else:
            searched.append(override)
    return fixed, searched


def _texts(override: Override) -> list[str]:
    """The values of an override that are checked: all of them, or both ends of an interval."""
    sweep, text = override.value(), override.input_line
    if not isinstance(sweep, IntervalSweep):
        if isinstance(sweep, ChoiceSweep | RangeSweep) and sweep.shuffle:
            raise UserError(f"{text}: leave shuffle out; the sampler chooses the order")
        choices = [choice.partition("=")[2] for choice in sweep_choices(override)]
        if len(choices) < 2:
            raise UserError(f"{text}: give several values, or one without a function")
        return choices
    low, high = float(sweep.start or 0), float(sweep.end or 0)
    unknown = sweep.tags - {_LOG}
    if unknown:
        raise UserError(f"{text}: unknown tag '{min(unknown)}'; write tag({_LOG},interval(LOW,HIGH))")
    if low >= high:
        raise UserError(f"{text}: the first number must be below the second")
    if sweep.tags and low <= 0:
        raise UserError(f"{text}: with {_LOG}, both numbers must be above 0")
    return [with_whole_number(str(low)), with_whole_number(str(high))]


def _range(override: Override, values: list[Any], texts: list[str], is_int: bool) -> Interval | Choices:
    """The range of a setting.

    Args:
        override: what gives it.
        values: the values of `_texts`, as `config.yaml` has them.
        texts: see `_texts`.
        is_int: whether the setting is an integer.
    """
    sweep = override.value()
    if isinstance(sweep, IntervalSweep):
        return Interval(values[0], values[1], bool(sweep.tags), is_int)
    labels = [value if type(value) in (int, float) else text for value, text in zip(values, texts, strict=True)]
    if len(set(labels)) < len(labels):
        raise UserError(f"{override.input_line}: a value is given twice")
    return Choices(tuple(labels), tuple(values))
