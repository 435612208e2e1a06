"""What a drawn shape covers of each pixel."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.rig.camera.coverage import polygon_covered

BOX = (slice(10, 70), slice(5, 75))


def test_a_polygon_covers_its_own_area_where_it_is():
    random = np.random.default_rng(3)
    v, u = np.mgrid[BOX]
    for _ in range(20):
        centre, angle = random.uniform((38.0, 38.0), (42.0, 42.0)), random.uniform(-np.pi, np.pi)
        along, aside = 15.0 * np.array([np.cos(angle), np.sin(angle)]), 2.5 * np.array([-np.sin(angle), np.cos(angle)])
        share = polygon_covered(BOX, [centre + np.array([-along - aside, along - aside, along + aside, aside - along])])
        assert share.min() >= 0.0
        assert share.max() <= 1.0 + 1e-6
        assert share.sum() == pytest.approx(150.0, abs=0.1)
        mean = np.array([(share * u).sum(), (share * v).sum()]) / share.sum()
        np.testing.assert_allclose(mean, centre, atol=0.01)


def test_a_hole_is_not_covered_and_what_is_outside_of_the_box_is_left_out():
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    share = polygon_covered(BOX, [(40.0, 40.0) + 20.0 * square, (40.0, 40.0) + 5.5 * square])
    assert share.sum() == pytest.approx(1600.0 - 121.0, rel=1e-4)
    assert share[30, 35] == 0.0
    np.testing.assert_allclose(polygon_covered(BOX, [(40.0, 40.0) + 100.0 * square]), 1.0, rtol=1e-5)
