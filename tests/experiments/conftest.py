"""What the tests of studies share."""

import pytest


@pytest.fixture
def optuna():
    """Optuna, which is installed for campaigns only."""
    return pytest.importorskip("optuna", reason="pip install optuna")
