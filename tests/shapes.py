"""Run-time checks of the shapes and dtypes that jaxtyping annotations state."""

from typing import Any

import beartype
import jaxtyping
import pytest


def check_shapes(monkeypatch: pytest.MonkeyPatch, owner: Any, *names: str) -> None:
    """Check the annotations of a class's or module's functions in every call, until the test ends."""
    for name in names:
        checked = jaxtyping.jaxtyped(getattr(owner, name), typechecker=beartype.beartype)
        monkeypatch.setattr(owner, name, checked)
