"""The bridge's model of the coils."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.field import CoilProperties, LoopCoils, coils_around
from test.rig.test_truth import loop_field

DISTANCE, RADIUS, FIELD = 0.05, 0.025, 1.2e-3


def coils(*angles: float) -> LoopCoils:
    """Return coils at some angles."""
    return LoopCoils(coils_around(angles or (0.0,), DISTANCE, RADIUS, FIELD))


@pytest.mark.parametrize("point", [(0.01, 0.012), (-0.013, -0.009), (0.0, 0.016), (0.016, 1e-7)])
def test_off_the_axis_it_is_the_sum_over_the_loop(point: tuple[float, float]):
    """Biot-Savart by the rectangle rule, which on a loop converges faster than any power."""
    found, middle = (loop_field(np.array(at), 0.0, DISTANCE, RADIUS, 1.0) for at in (point, (0.0, 0.0)))
    expected = FIELD / middle[0] * found
    np.testing.assert_allclose(coils().per_current(np.array(point))[:, 0], expected, rtol=1e-5, atol=1e-9)


UNLIKE = (
    CoilProperties("east", 0.1, 0.05, 0.025, 1.2e-3),
    CoilProperties("north", 1.4, 0.06, 0.02, -0.9e-3),
    CoilProperties("west", 3.0, 0.045, 0.03, 1.5e-3),
)


def test_the_field_at_the_centre_is_each_coils_own_and_points_away_where_it_is_negative():
    field = LoopCoils(UNLIKE).per_current(np.zeros(2))
    for coil, found in zip(UNLIKE, field.T, strict=True):
        expected = coil.field_per_current * np.array([np.cos(coil.angle), np.sin(coil.angle)])
        np.testing.assert_allclose(found, expected, atol=1e-15)
