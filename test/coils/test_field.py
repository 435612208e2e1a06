"""The bridge's model of the coils."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.field import LoopCoils

DISTANCE, RADIUS, FIELD = 0.05, 0.025, 1.2e-3


def coils(*angles: float) -> LoopCoils:
    """Return coils at some angles."""
    return LoopCoils(angles or (0.0,), DISTANCE, RADIUS, FIELD)


def test_the_field_at_the_centre_is_the_one_measured_and_points_to_the_coil():
    field = coils(0.0, np.pi / 2, 2.0).per_current(np.zeros(2))
    np.testing.assert_allclose(field[:, 0], [FIELD, 0.0], atol=1e-15)
    np.testing.assert_allclose(field[:, 1], [0.0, FIELD], atol=1e-15)
    np.testing.assert_allclose(field[:, 2], [FIELD * np.cos(2.0), FIELD * np.sin(2.0)], atol=1e-15)


@pytest.mark.parametrize("x", [-0.015, 0.0, 0.01])
def test_on_the_axis_it_is_the_closed_form(x: float):
    z = x - DISTANCE
    expected = FIELD * ((RADIUS**2 + DISTANCE**2) / (RADIUS**2 + z**2)) ** 1.5
    assert coils().per_current(np.array([x, 0.0]))[0, 0] == pytest.approx(expected, rel=1e-6)


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
