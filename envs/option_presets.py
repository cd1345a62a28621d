"""Presets of groups of env options: one name for several settings."""

import dataclasses
from collections.abc import Mapping
from typing import TypeVar

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.near_misses import unknown
from mjx_walk.utils.setting_fields import Dataclass

__all__ = ["changes", "preset"]

_Options = TypeVar("_Options", bound=Dataclass)


def preset(key: str, name: str, presets: Mapping[str, _Options]) -> _Options:
    """A copy of a preset.

    Args:
        key: of the group, such as `env.randomize`.
        name: of the preset.
        presets: options by name.

    Raises:
        UserError: an unknown name.
    """
    if name not in presets:
        raise UserError(unknown(key, name, presets))
    return dataclasses.replace(presets[name])


def changes(options: Dataclass) -> dict[str, object]:
    """The options that differ from their defaults."""
    defaults = vars(type(options)())
    return {name: value for name, value in vars(options).items() if value != defaults[name]}
