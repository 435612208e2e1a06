"""Which side of a tilted dish is nearer, by two rings of its rim."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.vision.dish.rings import perspective_by_rings

RADIUS, RATIO, DISTANCE, FOCAL = 0.0175, 1.045, 0.25, 3000.0  # m, of the radius, m, px
NEAR = 0.1


def middle_of_ring(radius: float, height: float, angle: float) -> float:
    """Return the middle of a ring's ellipse along the tilt [px], by its points as a tilted camera sees them."""
    x = radius * np.cos(np.linspace(0.0, 2.0 * np.pi, 721))
    depth = DISTANCE - x * math.sin(angle) - height * math.cos(angle)
    at = FOCAL * (x * math.cos(angle) - height * math.sin(angle)) / depth
    return 0.5 * float(at.min() + at.max())


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("degrees", [4.0, 6.0, 10.0])
def test_two_rings_in_one_plane_show_which_side_is_nearer(degrees: float, side: float):
    angle, radius_px = math.radians(degrees), FOCAL * RADIUS / DISTANCE
    offset = side * (middle_of_ring(RATIO * RADIUS, 0.0, angle) - middle_of_ring(RADIUS, 0.0, angle))
    found = perspective_by_rings(RATIO, offset, radius_px, angle, NEAR)
    assert found is not None
    nearness, error = found
    assert nearness * side > 0.0
    assert abs(nearness - side * RADIUS / DISTANCE) < 2.0 * error
    assert error < NEAR
    if degrees == 10.0:
        assert nearness == pytest.approx(side * RADIUS / DISTANCE, abs=0.25 * NEAR)
        assert abs(nearness) > 3.0 * error


def test_rings_of_different_heights_do_not_say_which_side_is_nearer():
    angle, radius_px = math.radians(8.0), FOCAL * RADIUS / DISTANCE
    for height in (0.002, 0.005, 0.01):
        offset = middle_of_ring(RATIO * RADIUS, height, angle) - middle_of_ring(RADIUS, 0.0, angle)
        assert perspective_by_rings(RATIO, offset, radius_px, angle, NEAR) is None


def test_rings_about_one_centre_leave_both_sides_as_likely():
    found = perspective_by_rings(RATIO, 0.0, 200.0, math.radians(3.5), NEAR)
    assert found is not None
    assert found[0] == pytest.approx(0.0, abs=1e-12)
    assert 0.4 * NEAR < found[1] < NEAR / math.sqrt(3.0)
