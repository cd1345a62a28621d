"""Settings that know their valid range: declared beside the default, checked in one place."""

import dataclasses
import math
from typing import Any

from mjx_walk.utils.errors import UserError


def setting(
    default: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A dataclass field with a default and the range that `validate` holds it to; for a tuple, each of its items."""
    limits = {"above": above, "at_least": at_least, "at_most": at_most, "below": below, "choices": choices}
    return dataclasses.field(default=default, metadata={k: v for k, v in limits.items() if v is not None})


def validate(config: Any, prefix: str = "") -> None:
    """Check every setting of a dataclass, nested ones included.

    Raises:
        UserError: the first value out of range, named by its full key. NaN is never in range.
    """
    for field in dataclasses.fields(config):
        value, key = getattr(config, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            validate(value, key + ".")
            continue
        for item in value if isinstance(value, list | tuple) else (value,):
            problem = _problem(item, field.metadata)
            if problem:
                raise UserError(f"{key}={value}: {problem}")


def _problem(value: Any, limits: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, float) and math.isnan(value):
        return "must be a number"
    # Written so that a value that compares with nothing fails.
    if "above" in limits and not value > limits["above"]:
        return f"must be above {limits['above']}"
    if "at_least" in limits and not value >= limits["at_least"]:
        return f"must be at least {limits['at_least']}"
    if "at_most" in limits and not value <= limits["at_most"]:
        return f"must be at most {limits['at_most']}"
    if "below" in limits and not value < limits["below"]:
        return f"must be below {limits['below']}"
    if "choices" in limits and value not in limits["choices"]:
        return f"choose one of: {', '.join(limits['choices'])}"
    if ("above" in limits or "at_least" in limits) and isinstance(value, float) and math.isinf(value):
        return "must be finite"
    return None
