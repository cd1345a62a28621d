"""Schedules, half way and at their ends."""

import jax.numpy as jnp
import pytest

from mjx_walk.common.optimizers import anneal_discount, remaining_fraction, schedule_factor


def test_a_schedule_ends_at_its_horizon():
    left = [float(remaining_fraction(jnp.float32(steps), 200)) for steps in (0, 50, 200, 300)]
    assert left == pytest.approx([1.0, 0.75, 0.0, 0.0])
    assert (
        schedule_factor("linear", jnp.float32(0.25)) == 0.25 and schedule_factor("constant", jnp.float32(0.25)) == 1.0
    )
    assert remaining_fraction(jnp.float32(25e10), 10**12) == pytest.approx(0.75)  # more than 32 bits


def test_a_discounts_horizon_changes_by_the_same_factor_every_step():
    """From 10 steps over 100 to 1,000."""
    horizons = [1.0 / (1.0 - float(anneal_discount(0.9, 0.999, jnp.float32(left)))) for left in (1.0, 0.5, 0.0)]
    assert horizons == pytest.approx([10.0, 100.0, 1000.0], rel=1e-3)
    assert anneal_discount(0.9, None, jnp.float32(0.5)) == 0.9
