"""The bridge's model of the coils."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.field import CoilProperties, LoopCoils, coils_around

DISTANCE, RADIUS, FIELD = 0.05, 0.025, 1.2e-3


def coils(*angles: float) -> LoopCoils:
    """Return coils at some angles."""
    return LoopCoils(coils_around(angles or (0.0,), DISTANCE, RADIUS, FIELD))


@pytest.mark.parametrize("point", [(0.01, 0.012), (-0.013, -0.009), (0.0, 0.016), (0.016, 1e-7)])
def test_off_the_axis_it_is_the_sum_over_the_loop(point: tuple[float, float]):
    """Biot-Savart by the rectangle rule, which on a loop converges faster than any power."""
    turn = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    ring = np.column_stack([np.full(400, DISTANCE), RADIUS * np.cos(turn), RADIUS * np.sin(turn)])
    flow = np.column_stack([np.zeros(400), -RADIUS * np.sin(turn), RADIUS * np.cos(turn)])

    def summed(at: np.ndarray) -> np.ndarray:
        apart = at - ring
        return (np.cross(flow, apart) / np.linalg.norm(apart, axis=1)[:, None] ** 3).sum(axis=0)

    scale = FIELD / summed(np.zeros(3))[0]
    expected = scale * summed(np.array([*point, 0.0]))[:2]
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
