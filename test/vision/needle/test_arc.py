"""Arcs: there and back, and the fit of any circle or line."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magnetosuture_thread.vision.needle.arc import Arc, fit_arc

ANGLES = st.floats(-3.1, 3.1)
CURVATURES = st.floats(-0.035, 0.035)


@given(angle=ANGLES, curvature=CURVATURES)
@settings(max_examples=60, deadline=None)
def test_coordinates_are_the_inverse_of_points(angle: float, curvature: float):
    arc = Arc(np.array([100.0, 80.0]), angle, curvature)
    along, aside = np.linspace(-4.0, 84.0, 30), np.linspace(-5.0, 5.0, 30)
    back = arc.coordinates(arc.at(along, aside))
    np.testing.assert_allclose(back[0], along, atol=0.01)
    np.testing.assert_allclose(back[1], aside, atol=0.01)


@given(angle=ANGLES, curvature=CURVATURES)
@settings(max_examples=60, deadline=None)
def test_a_fit_goes_through_points_of_an_arc(angle: float, curvature: float):
    points = Arc(np.array([300.0, 200.0]), angle, curvature).at(np.linspace(0.0, 80.0, 50))
    fitted = fit_arc(points)
    assert abs(abs(fitted.curvature) - abs(curvature)) < 1e-5
    assert np.abs(fitted.coordinates(points)[1]).max() < 0.01


@pytest.mark.parametrize("curvature", [0.0, 0.02, -0.03])
def test_a_moved_arc_has_offset_slope_and_second_derivative_where_it_leaves(curvature: float):
    arc = Arc(np.array([10.0, 20.0]), 0.7, curvature)
    beside = arc.moved(15.0, 4.0, 0.0, 0.0).at(np.linspace(0.0, 30.0, 7))
    np.testing.assert_allclose(arc.coordinates(beside)[1], 4.0, atol=1e-9)
    for offset, slope, bend in ((4.0, 0.3, 0.0), (-4.0, 0.3, 0.0), (0.0, 0.0, 0.01)):
        step = 0.1
        along, aside = arc.coordinates(arc.moved(15.0, offset, slope, bend).at(np.array([-step, 0.0, step])))
        assert (along[1], aside[1]) == pytest.approx((15.0, offset))
        assert (aside[2] - aside[0]) / (along[2] - along[0]) == pytest.approx(slope, abs=1e-4)
        if not slope:
            assert (aside[2] - 2.0 * aside[1] + aside[0]) / step**2 == pytest.approx(bend, abs=1e-4)
