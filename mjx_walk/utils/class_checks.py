"""The checks of a class that a user registers under a name, as a task or an algorithm."""

import re
import sys
from collections.abc import Mapping

from mjx_walk.utils.errors import UserError

__all__ = ["check_class", "check_decorated", "identity"]


def check_class(what: str, name: str, kind: object, base: type, advice: str, known: Mapping[str, type]) -> None:
    """Check a class that is to be registered.

    Args:
        what: `a task` or `an algorithm`.
        name: under which it is to be registered.
        kind: the class.
        base: the class from which it must derive.
        advice: what to give instead, for the message.
        known: classes that are registered already, by name. One that stays the same may be registered again.

    Raises:
        UserError: an invalid name, a class of another kind, one with abstract methods, or a name that is taken.
    """
    noun = what.rpartition(" ")[2]
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UserError(f"{what} cannot be called '{name}'; use lower-case letters, digits and underscores")
    if not (isinstance(kind, type) and issubclass(kind, base)):
        found = f"the {type(kind).__name__} {kind.__name__}" if hasattr(kind, "__name__") else repr(kind)
        raise UserError(f"the {noun} '{name}' is {found}; give {advice}")
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    if missing:
        raise UserError(f"the class {kind.__name__} of the {noun} '{name}' does not define: {', '.join(missing)}")
    if name in known and identity(known[name]) != identity(kind):
        raise UserError(f"{what} '{name}' is registered already, from {identity(known[name])}; choose another name")


def check_decorated(settings: type, whose: str) -> None:
    """Check that a class of settings is a dataclass itself, and not only its base.

    Args:
        settings: the class.
        whose: what it belongs to, for the message.

    Raises:
        UserError: it is not.
    """
    if "__dataclass_fields__" not in vars(settings):
        raise UserError(f"decorate {settings.__name__}, the {whose}, with @dataclasses.dataclass")


def identity(kind: type) -> str:
    """The file, or without one the module, and the name of a class. It stays the same when the file runs again."""
    module = sys.modules.get(kind.__module__)
    return f"{getattr(module, '__file__', None) or kind.__module__}:{kind.__qualname__}"
